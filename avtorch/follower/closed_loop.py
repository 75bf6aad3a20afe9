"""The closed loop of law, delay and lag: simulated from the recorded leader alone, and whether it is string stable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.follower.laws import FollowerMeasurements, HeadwayLaw, of_law
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import delay_key
from avtorch.vehicle.stability import chain_verdict, frequencies
from avtorch.vehicle.stability.chain import actuator


class LoopErrors(NamedTuple):
    """Root mean square errors of stretches begun at the measured state, and how much the car amplifies.

    `spacing` [m], `speed` [m/s]; `amplified`, `amplified_simulated`: spread of the car's speed over the leader's, as
    measured and in the simulated loop.
    """

    spacing: float
    speed: float
    amplified: float
    amplified_simulated: float


def loop_errors(
    law: HeadwayLaw, values: Mapping[str, float], seen: FollowerMeasurements, dt: float, *, seconds: float = 60.0
) -> LoopErrors:
    """Simulate stretches of `seconds` of one drive, in one batch; rows `dt` [s] apart.

    `values`: the law's as `law.*`, `T_L` [s], the delay [s] by `delay_key()`; `K_L` is 1.
    """
    own = of_law(values)
    s, v, lead = (x.numpy() for x in seen)
    length = min(round(seconds / dt), len(s) - 1)
    delay = values.get(delay_key(), 0.0) / dt
    whole, part = int(delay), delay - int(delay)
    starts = np.arange(0, len(s) - length, length)
    rows = starts + np.arange(length + 1)[:, None]
    # commands before a stretch follow from the measured motion
    demanded = law.command(own, seen).numpy()
    sent = [demanded[np.maximum(starts - k, 0)] for k in range(whole + 2, 0, -1)]
    keep = float(np.exp(-dt / values["T_L"]))
    speed, spacing = v[rows[0]].copy(), s[rows[0]].copy()
    accel = np.gradient(v, dt)[rows[0]]
    speeds, spacings = [speed], [spacing]
    for k in range(length):
        now = FollowerMeasurements(*(torch.as_tensor(x) for x in (spacing, speed, lead[rows[k]])))
        sent.append(law.command(own, now).numpy())
        acting = (1 - part) * sent[-1 - whole] + part * sent[-2 - whole]
        ahead = keep * accel + (1 - keep) * acting
        faster = np.maximum(speed + 0.5 * dt * (accel + ahead), 0.0)
        spacing = spacing + 0.5 * dt * (lead[rows[k]] + lead[rows[k + 1]] - speed - faster)
        speed, accel = faster, ahead
        speeds.append(speed)
        spacings.append(spacing)
    simulated, gaps = np.stack(speeds), np.stack(spacings)
    return LoopErrors(
        spacing=float(np.sqrt(np.mean((gaps - s[rows]) ** 2))),
        speed=float(np.sqrt(np.mean((simulated - v[rows]) ** 2))),
        amplified=_spread(v[rows]) / _spread(lead[rows]),
        amplified_simulated=_spread(simulated) / _spread(lead[rows]),
    )


def keeps_speed(seen: Sequence[FollowerMeasurements], dt: float, *, seconds: float = 60.0) -> float:
    """Root mean square error [m/s] over the same stretches of a car that keeps its initial speed."""
    off = []
    for speed in (one.speed.numpy() for one in seen):
        length = min(round(seconds / dt), len(speed) - 1)
        rows = np.arange(0, len(speed) - length, length) + np.arange(length + 1)[:, None]
        off.append((speed[rows] - speed[rows[0]]).ravel())
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _spread(x: FloatArray) -> float:
    """Spread about each stretch's own mean, (row, stretch)."""
    return float(np.sqrt(np.mean((x - x.mean(0)) ** 2))) + 1e-12


@dataclass(frozen=True)
class LoopStability:
    """`p_locally_stable`, `p_string_stable`; `peak_gain` [-] over the draws that are locally stable, None where few."""

    speed: float
    p_locally_stable: float
    p_string_stable: float
    peak_gain: Quantity | None


def loop_stability(law: HeadwayLaw, draws: Mapping[str, FloatArray], speeds: Sequence[float]) -> list[LoopStability]:
    """Stability for small motions about `speeds` [m/s], of draws (draw,) by key.

    The result does not depend on how the loop is divided into controller and car: only the product of gains and `K_L`
    counts.
    """
    own, lag = of_law(draws), torch.as_tensor(draws["T_L"])
    delay = torch.as_tensor(draws.get(delay_key(), np.zeros_like(draws["T_L"])))
    chain = actuator(frequencies(points=500), lag, torch.ones_like(lag), delay)
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
