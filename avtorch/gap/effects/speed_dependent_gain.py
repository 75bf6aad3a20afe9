"""The gain changes with speed: a pedal or brake map that is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


class SlopeOverSpeed(Effect):
    """A factor that is 1 at `mean_speed` [m/s], which is taken from a drive."""

    mean_speed: Number

    place = "actuator"
    needs_speed = True
    settings = (Domain("mean_speed", 0.1, 150.0, "m/s"),)

    def _factor(self, slope: Number, row: EffectContext, least: float) -> Tensor:
        """At least `least`, outside a drive's range of speeds."""
        return (1 + tensor(slope) * (row.speed / tensor(self.mean_speed) - 1)).clamp_min(least)

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        if speed is None:
            return self
        moving = speed[speed > 0.3]
        return replace(self, mean_speed=float(moving.mean())) if len(moving) else self


@register
@dataclass(frozen=True)
class SpeedDependentGain(SlopeOverSpeed):
    """`K_L (1 + gain_slope (v - v_mean) / v_mean)`; neutral at 0. `mean_speed` [m/s] is taken from a drive.

    Possible up to 2 either way, where the gain vanishes at half or at one and a half times the mean speed.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SpeedDependentGain, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[5.0], [25.0]], dtype=torch.float64).expand(2, 200)
        >>> car = plant([SpeedDependentGain(0.3, mean_speed=15.0)])
        >>> pulling = SimulatorInput(time, torch.ones_like(speed), speed=speed)
        >>> car.response(pulling).accel[:, -1].round(decimals=2).tolist()
        [0.8, 1.2]
    """

    gain_slope: Number = 0.3
    mean_speed: Number = 15.0

    name = "speed_dependent_gain"
    meaning = "the realised share of the command depends on speed"
    equation = "K_L (1 + slope (v - v_mean) / v_mean)"
    parameters = (Parameter("gain_slope", "-", 0.0, -0.4, 0.4, "real", possible=(-2.0, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"commands do {'more' if values['gain_slope'] > 0 else 'less'} the faster the car is"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        return self._factor(self.gain_slope, row, 0.0), 1.0
