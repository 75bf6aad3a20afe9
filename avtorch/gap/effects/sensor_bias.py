"""Sensor bias: the accelerometer has a constant offset."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class SensorBias(Effect):
    """`bias_mps2` on top of the measured acceleration; neutral at 0.

    Possible up to 1 m/s² either way, an accelerometer that is tilted by 6 degrees.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, SensorBias, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> response = plant([SensorBias(0.12)]).response(SimulatorInput(time, torch.sin(time)))
        >>> bool(torch.allclose(response.accel_measured, response.accel + 0.12))
        True
    """

    bias_mps2: Number = 0.12

    name = "sensor_bias"
    place = "sensor"
    order = 2
    meaning = "the accelerometer has a constant offset"
    equation = "a + b"
    parameters = (Parameter("bias_mps2", "m/s²", 0.0, -0.25, 0.25, "real", possible=(-1.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        bias = values["bias_mps2"]
        return f"the accelerometer reads {abs(bias):.2g} m/s² too {'high' if bias > 0 else 'low'}"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return x + tensor(self.bias_mps2)
