"""Assumed controllers of a follower: demanded acceleration as a function of their inputs, with parameters to identify.

The controller of a production car is not public. Each law here is a hypothesis, tested on held-out data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap import Parameter

Values = Mapping[str, Tensor]


class FollowerMeasurements(NamedTuple):
    """The law's inputs, (time,): `spacing` [m], own `speed` and `lead_speed` [m/s]."""

    spacing: Tensor
    speed: Tensor
    lead_speed: Tensor


class Slopes(NamedTuple):
    """Slopes of the demand for small motions: per metre of spacing, and per m/s of own and of lead speed."""

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

    def slopes(self, values: Values, speed: float) -> Slopes:
        """Slopes in equilibrium at `speed` [m/s], `values` (...)."""
        ...


@dataclass(frozen=True)
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

    def slopes(self, values: Values, speed: float) -> Slopes:
        k_s, k_v, h = (values[name] for name in ("spacing_gain_per_s2", "speed_gain_per_s", "time_gap_s"))
        return Slopes(k_s, -(k_s * h + k_v), k_v)


@dataclass(frozen=True)
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

    def slopes(self, values: Values, speed: float) -> Slopes:
        a, b, h, s_0, v_0 = (values[p.name] for p in self.parameters)
        wanted, spacing = s_0 + h * speed, self.spacing(values, speed)
        on_wanted = -2 * a * wanted / spacing**2
        closing = speed / (2 * (a * b).sqrt())
        return Slopes(
            spacing=2 * a * wanted**2 / spacing**3,
            speed=-4 * a * speed**3 / v_0**4 + on_wanted * (h + closing),
            lead_speed=-on_wanted * closing,
        )


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
