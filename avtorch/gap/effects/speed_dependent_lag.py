"""The lag changes with speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_LEAST = 0.05  # the factor's lower limit, outside a drive's range of speeds


@register
@dataclass(frozen=True)
class SpeedDependentLag(Effect):
    """`T_L (1 + lag_slope (v - v_mean) / v_mean)`; neutral at 0. `mean_speed` [m/s] is taken from a drive.

    `pivot` [-]: the speed, relative to the mean one, at which the lag is unchanged. It only rescales T_L if the effect
    has no onset, and is then 1.

    Possible up to 2 either way, where the lag vanishes at half or at one and a half times the mean speed.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SpeedDependentLag, plant
        >>> time = torch.arange(60, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[5.0], [25.0]], dtype=torch.float64).expand(2, 60)
        >>> car, step = plant([SpeedDependentLag(0.5)]), (time >= 0.5).double().expand(2, 60)
        >>> slow, quick = car.response(SimulatorInput(time, step, speed=speed)).accel[:, 20].tolist()
        >>> slow > quick  # 0.5 s after the step: the lag grows with the speed
        True
    """

    lag_slope: Number = 0.5
    mean_speed: Number = 15.0
    pivot: Number = 1.0

    name = "speed_dependent_lag"
    place = "actuator"
    needs_speed = True
    meaning = "the actuator is slower at some speeds"
    equation = "T_L (1 + slope (v - v_mean) / v_mean)"
    parameters = (
        Parameter("lag_slope", "-", 0.0, -0.7, 0.7, "real", possible=(-2.0, 2.0), beyond="no lag varies that much"),
        Parameter("pivot", "-", None, 0.6, 1 / 0.6, reported=False, of_onset=True),
    )
    settings = (Domain("mean_speed", 0.1, 150.0, "m/s"),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the actuator is slower the {'faster' if values['lag_slope'] > 0 else 'slower'} the car is"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, Tensor]:
        away = row.speed / (tensor(self.mean_speed) * tensor(self.pivot)) - 1
        factor = (1 + tensor(self.lag_slope) * away).clamp_min(_LEAST)
        return 1.0, factor

    def prepared(self, time: Tensor, speed: Tensor | None, position: Tensor | None) -> Self:
        if speed is None:
            return self
        moving = speed[speed > 0.3]
        return replace(self, mean_speed=float(moving.mean())) if len(moving) else self
