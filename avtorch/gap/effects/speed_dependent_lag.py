"""The lag changes with speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.effects.speed_dependent_gain import SlopeOverSpeed
from avtorch.gap.simulator.effect import EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number


@register
@dataclass(frozen=True)
class SpeedDependentLag(SlopeOverSpeed):
    """`T_L (1 + lag_slope (v - v_mean) / v_mean)`; neutral at 0. `mean_speed` [m/s] is taken from a drive.

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

    name = "speed_dependent_lag"
    meaning = "the actuator is slower at some speeds"
    equation = "T_L (1 + slope (v - v_mean) / v_mean)"
    parameters = (Parameter("lag_slope", "-", 0.0, -0.7, 0.7, "real", possible=(-2.0, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"the actuator is slower the {'faster' if values['lag_slope'] > 0 else 'slower'} the car is"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, Tensor]:
        return 1.0, self._factor(self.lag_slope, row, 0.05)
