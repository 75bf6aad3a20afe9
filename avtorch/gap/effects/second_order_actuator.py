"""Second-order actuator: the response can overshoot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_NO_OVERSHOOT = 0.8
"""Damping from which a step overshoots by less than 2 %."""


@register
@dataclass(frozen=True)
class SecondOrderActuator(Effect):
    """`a'' / omega² + 2 zeta a' / omega + a = K u` in place of the one pole.

    Fitted as `tau² a'' + T_L a' + a = K u` with `tau = inverse_frequency_s`: neutral at 0, where it is exactly GLVD,
    and `T_L` keeps its meaning, the slope of the phase. The answer reports `natural_frequency_radps = 1 / tau` and
    `damping_ratio = T_L / (2 tau)`. With `damping_ratio` given, `plant` sets `T_L` to `2 zeta tau`; from then on `T_L`
    determines the damping, and the effect in the plant has no `damping_ratio` of its own. With an onset during a drive,
    `T_L` is the lag before it and `lag_ratio` times `T_L` the lag after it.

    Possible are 0.5 to 60 rad/s, periods of 12 s to 0.1 s, with damping ratios of 0.03 to 5.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SecondOrderActuator, plant
        >>> time = torch.arange(400, dtype=torch.float64) * 0.01
        >>> car = plant([SecondOrderActuator(inverse_frequency_s=0.2, damping_ratio=0.3)])
        >>> round(car.response(SimulatorInput(time, (time >= 0.5).double())).accel.max().item(), 2)  # it overshoots
        1.37
    """

    inverse_frequency_s: Number = 1 / 6
    damping_ratio: Number | None = None
    lag_ratio: Number = 1.0

    name = "second_order_actuator"
    place = "actuator"
    order = 1
    meaning = "the actuator has inertia and may overshoot"
    equation = "a'' = omega² (K u - a) - 2 zeta omega a'"
    parameters = (
        Parameter("inverse_frequency_s", "s", 0.0, 1 / 12, 1 / 3, reported=False),
        Parameter("lag_ratio", "-", 1.0, 0.65, 1 / 0.65, reported=False),
    )
    derived = (
        Parameter("natural_frequency_radps", "rad/s", None, 3.0, 12.0, possible=(0.5, 60.0)),
        Parameter("damping_ratio", "-", None, 0.2, 0.9, possible=(0.03, 5.0)),
    )
    settings = (Domain("natural_frequency_radps", 1e-3, 1e5, "rad/s"), Domain("damping_ratio", 1e-3, 1e3))

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        ends = "overshoots" if values["damping_ratio"] < _NO_OVERSHOOT else "has inertia"
        return f"the actuator {ends} with a natural frequency of {values['natural_frequency_radps']:.2g} rad/s"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, Tensor]:
        return 1.0, tensor(self.lag_ratio)  # the second derivative is integrated in the actuator, see `actuator.py`

    def actuator_parameters(self) -> Mapping[str, Tensor]:
        return {"tau": tensor(self.inverse_frequency_s)}

    def report(self, T_L: Tensor) -> dict[str, Tensor]:
        tau = tensor(self.inverse_frequency_s)
        return {"natural_frequency_radps": 1 / tau, "damping_ratio": T_L * tensor(self.lag_ratio) / (2 * tau)}

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """The effect from `natural_frequency_radps` and `damping_ratio` (without it the plant keeps its `T_L`)."""
        given = dict(values)
        if "natural_frequency_radps" in given:
            frequency = given.pop("natural_frequency_radps")
            if not bool(torch.all(tensor(frequency) > 0)):
                raise InputError(f"natural_frequency_radps: found {frequency!r}, needs > 0 rad/s")
            given["inverse_frequency_s"] = 1 / frequency
        return super().of(given)

    def lag_apart(self) -> tuple[Self, Tensor | None]:
        if self.damping_ratio is None:
            return self, None
        lag = 2 * tensor(self.damping_ratio) * tensor(self.inverse_frequency_s)
        return replace(self, damping_ratio=None), lag
