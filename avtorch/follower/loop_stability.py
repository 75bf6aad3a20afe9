"""Is the loop string stable: P and peak gain from draws of law, lag and delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from avtorch.follower.laws import Law
from avtorch.gap.quantity import Quantity
from avtorch.vehicle.stability import chain_verdict, frequencies
from avtorch.vehicle.stability.chain import actuator

Float = NDArray[np.float64]


@dataclass(frozen=True)
class LoopStability:
    """`p_locally_stable`, `p_string_stable`; `peak_gain` [-] over the draws that are locally stable, None where few."""

    speed: float
    p_locally_stable: float
    p_string_stable: float
    peak_gain: Quantity | None


def loop_stability(law: Law, draws: Mapping[str, Float], speeds: Sequence[float]) -> list[LoopStability]:
    """For small motions about `speeds` [m/s], of draws (draw,) by key.

    What holds of the loop holds whatever of it is controller or car: of gains and `K_L` only the product counts.
    """
    values = {k: torch.as_tensor(x) for k, x in draws.items()}
    own = {k.partition(".")[2]: x for k, x in values.items() if k.startswith("law.")}
    delay = values.get("dead_time.delay_s", torch.zeros_like(values["T_L"]))
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
