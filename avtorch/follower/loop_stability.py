"""Is the loop string stable: P and peak gain from draws of law, lag and delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from avtorch.arrays import FloatArray
from avtorch.follower.laws import HeadwayLaw
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import delay_key
from avtorch.vehicle.stability import chain_verdict, frequencies
from avtorch.vehicle.stability.chain import actuator


@dataclass(frozen=True)
class LoopStability:
    """`p_locally_stable`, `p_string_stable`; `peak_gain` [-] over the draws that are locally stable, None where few.

    Example:
        >>> from avtorch.follower import LoopStability
        >>> at = LoopStability(speed=20.0, p_locally_stable=1.0, p_string_stable=0.04, peak_gain=None)
        >>> at.p_string_stable < 0.05 < at.p_locally_stable
        True
    """

    speed: float
    p_locally_stable: float
    p_string_stable: float
    peak_gain: Quantity | None


def loop_stability(law: HeadwayLaw, draws: Mapping[str, FloatArray], speeds: Sequence[float]) -> list[LoopStability]:
    """Stability for small motions about `speeds` [m/s], of draws (draw,) by key.

    The result does not depend on how the loop is divided into controller and car: only the product of gains and `K_L`
    counts.

    Example:
        >>> import numpy as np
        >>> from avtorch.follower import ConstantTimeGap, loop_stability
        >>> law = {"spacing_gain_per_s2": 0.1, "speed_gain_per_s": 0.5, "standstill_m": 3.0}
        >>> draws = {"T_L": np.full(50, 0.4), "law.time_gap_s": np.linspace(0.8, 2.0, 50)}
        >>> draws |= {f"law.{name}": np.full(50, value) for name, value in law.items()}
        >>> [round(at.p_string_stable, 2) for at in loop_stability(ConstantTimeGap(), draws, speeds=[10.0, 25.0])]
        [0.26, 0.26]
    """
    values = {k: torch.as_tensor(x) for k, x in draws.items()}
    own = {k.partition(".")[2]: x for k, x in values.items() if k.startswith("law.")}
    delay = values.get(delay_key(), torch.zeros_like(values["T_L"]))
    chain = actuator(frequencies(points=500), values["T_L"], torch.ones_like(values["T_L"]), delay)
    out = []
    for speed in speeds:
        s, v, lead = law.slopes(own, speed)
        gains = torch.stack(torch.broadcast_tensors(s, lead, torch.zeros_like(lead)), -1)
        seen = chain_verdict(chain, (-v - lead) / s, gains)
        peaks = seen.peak_gain[seen.locally_stable].numpy()
        out.append(
            LoopStability(
                speed=float(speed),
                p_locally_stable=float(seen.locally_stable.double().mean()),
                p_string_stable=float(seen.string_stable.double().mean()),
                peak_gain=Quantity.of_draws(peaks) if len(peaks) > 0.5 * len(delay) else None,
            )
        )
    return out
