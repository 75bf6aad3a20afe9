"""Sensor scale: the accelerometer's gain is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class SensorScale(Effect):
    """The measured acceleration times `scale`; neutral at 1.

    A speed that reads 1 / `scale` of the truth (a wheel's radius) beside a right accelerometer is the same log, of a
    car whose gain is K_L times `scale`. Possible are half to twice the true value; beyond that the unit is wrong.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorScale, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> response = plant([SensorScale(1.12)]).response(SimulatorInput(time, torch.sin(time)))
        >>> bool(torch.allclose(response.accel_measured, 1.12 * response.accel))
        True
    """

    scale: Number = 1.12

    name = "sensor_scale"
    place = "sensor"
    order = 1
    meaning = "the accelerometer's gain is wrong"
    equation = "scale a"
    parameters = (Parameter("scale", "-", 1.0, 0.83, 1.2, possible=(0.5, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        scale = values["scale"]
        more = "more" if scale > 1 else "less"
        return f"the accelerometer shows {abs(100 * (scale - 1)):.2g} % {more} than the speed: one scale is wrong"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return tensor(self.scale) * x
