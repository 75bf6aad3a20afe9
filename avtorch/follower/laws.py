"""Assumed controllers of a follower, and the closed loop of law, delay and lag that each makes.

The controller of a production car is not public. Each law here is a hypothesis, tested on held-out data: the demanded
acceleration as a function of its inputs, with parameters to identify. The loop is simulated from the recorded leader
alone, and is string stable or not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.gap import Parameter
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import delay_key
from avtorch.vehicle.stability import chain_verdict, frequencies
from avtorch.vehicle.stability.chain import actuator

Values = Mapping[str, Tensor]
_STRETCH_S = 60.0  # of a loop that is simulated from the leader alone


class FollowerMeasurements(NamedTuple):
    """The law's inputs, (time,): `spacing` [m], own `speed` and `lead_speed` [m/s]."""

    spacing: Tensor
    speed: Tensor
    lead_speed: Tensor


class HeadwayLaw(Protocol):
    """A headway law by `name`, with `parameters`."""

    name: str
    parameters: tuple[Parameter, ...]

    def command(self, values: Values, seen: FollowerMeasurements) -> Tensor:
        """Demanded acceleration (..., time) [m/s²], `values` (..., 1)."""
        ...

    def spacing(self, values: Values, speed: float) -> Tensor:
        """Equilibrium spacing (...) [m] at `speed` [m/s], `values` (...)."""
        ...


class ConstantTimeGap:
    """`u = k_s (s - s_0 - h v) + k_v (v_lead - v)`: the linear law of the paper, without its own acceleration.

    A gain on its own acceleration could not be distinguished from another lag.
    """

    name = "constant_time_gap"
    parameters = (
        Parameter("spacing_gain_per_s2", "1/s²", None, 0.02, 0.3),
        Parameter("speed_gain_per_s", "1/s", None, 0.1, 0.9),
        Parameter("time_gap_s", "s", None, 0.7, 2.2),
        Parameter("standstill_m", "m", None, -2.0, 8.0, "real"),
    )

    def command(self, values: Values, seen: FollowerMeasurements) -> Tensor:
        wanted = values["standstill_m"] + values["time_gap_s"] * seen.speed
        pull = values["spacing_gain_per_s2"] * (seen.spacing - wanted)
        return pull + values["speed_gain_per_s"] * (seen.lead_speed - seen.speed)

    def spacing(self, values: Values, speed: float) -> Tensor:
        return values["standstill_m"] + values["time_gap_s"] * speed


class IntelligentDriver:
    """The Intelligent Driver Model (Treiber, Hennecke and Helbing 2000, Eq. 2 and 3).

    `u = a (1 - (v / v_0)^4 - (s* / s)²)` with `s* = s_0 + h v + v (v - v_lead) / (2 sqrt(a b))`.
    """

    name = "intelligent_driver"
    parameters = (
        Parameter("max_accel_mps2", "m/s²", None, 0.4, 2.5),
        Parameter("comfort_brake_mps2", "m/s²", None, 0.6, 4.0),
        Parameter("time_gap_s", "s", None, 0.6, 2.2),
        Parameter("standstill_m", "m", None, 1.0, 6.0),
        Parameter("desired_speed_mps", "m/s", None, 22.0, 55.0),
    )

    def command(self, values: Values, seen: FollowerMeasurements) -> Tensor:
        a, b = values["max_accel_mps2"], values["comfort_brake_mps2"]
        closing = seen.speed * (seen.speed - seen.lead_speed) / (2 * (a * b).sqrt())
        wanted = values["standstill_m"] + (values["time_gap_s"] * seen.speed + closing).clamp_min(0.0)
        return a * (1 - (seen.speed / values["desired_speed_mps"]) ** 4 - (wanted / seen.spacing.clamp_min(0.5)) ** 2)

    def spacing(self, values: Values, speed: float) -> Tensor:
        free = (1 - (speed / values["desired_speed_mps"]) ** 4).clamp_min(1e-3)
        return (values["standstill_m"] + values["time_gap_s"] * speed) / free.sqrt()


LAWS: dict[str, HeadwayLaw] = {law.name: law for law in (ConstantTimeGap(), IntelligentDriver())}
"""The laws that a follower may obey, by name."""


def law_named(name: str) -> HeadwayLaw:
    """Raises `InputError` for a law that is not known."""
    if name not in LAWS:
        raise InputError(f"law: found {name!r}, needs one of {', '.join(LAWS)}")
    return LAWS[name]


def of_law(values: Mapping[str, float | FloatArray | Tensor]) -> dict[str, Tensor]:
    """A law's own values by name, out of those of a loop, in which they are `law.NAME`; in their shape."""
    return {
        k.removeprefix("law."): torch.as_tensor(x, dtype=torch.float64) for k, x in values.items() if k[:4] == "law."
    }


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
    law: HeadwayLaw, values: Mapping[str, float], seen: FollowerMeasurements, dt: float, *, seconds: float = _STRETCH_S
) -> LoopErrors:
    """Simulate stretches of `seconds` of one drive, in one batch; rows `dt` [s] apart.

    `values`: the law's as `law.*`, `T_L` [s], the delay [s] by `delay_key()`; `K_L` is 1.
    """
    own = of_law(values)
    s, v, lead = (x.numpy() for x in seen)
    delay = values.get(delay_key(), 0.0) / dt
    whole, part = int(delay), delay - int(delay)
    rows = _stretches(len(s), dt, seconds)
    starts = rows[0]
    # commands before a stretch follow from the measured motion
    demanded = law.command(own, seen).numpy()
    sent = [demanded[np.maximum(starts - k, 0)] for k in range(whole + 2, 0, -1)]
    keep = float(np.exp(-dt / values["T_L"]))
    speed, spacing = v[rows[0]].copy(), s[rows[0]].copy()
    accel = np.gradient(v, dt)[rows[0]]
    speeds, spacings = [speed], [spacing]
    for k in range(len(rows) - 1):
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


def keeps_speed(seen: Sequence[FollowerMeasurements], dt: float) -> float:
    """Root mean square error [m/s] over the same stretches of a car that keeps its initial speed."""
    off = []
    for speed in (one.speed.numpy() for one in seen):
        rows = _stretches(len(speed), dt, _STRETCH_S)
        off.append((speed[rows] - speed[rows[0]]).ravel())
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _stretches(count: int, dt: float, seconds: float) -> IntArray:
    """Rows (step, stretch) of a drive of `count` rows, cut into stretches of so many `seconds`."""
    length = min(round(seconds / dt), count - 1)
    return np.arange(0, count - length, length) + np.arange(length + 1)[:, None]


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
        rest = torch.full_like(lag, speed)
        at = [x.detach().requires_grad_() for x in (law.spacing(own, speed), rest, rest)]
        # of the demand for small motions: per metre of spacing, and per m/s of own and of lead speed
        s, v, lead = torch.autograd.grad(law.command(own, FollowerMeasurements(*at)).sum(), at)
        gains = torch.stack([s, lead, torch.zeros_like(lead)], -1)
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
