"""Constant resistance: rolling resistance, a dragging brake."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class ConstantResistance(Effect):
    """`-resistance_mps2` while the car moves, always where no speed was measured; neutral at 0.

    Possible up to 3.5 m/s²: loose sand, or a motor that brakes as soon as the pedal is released.

    Example:
        >>> import torch
        >>> from avtorch.gap import ConstantResistance, SimulatorInput, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> rolling = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 10.0))
        >>> plant([ConstantResistance(0.12)]).response(rolling).accel[-1].item()
        -0.12
    """

    resistance_mps2: Number = 0.12

    name = "constant_resistance"
    place = "body"
    meaning = "the same deceleration at every speed"
    words = "the car is slowed by {resistance_mps2:.2g} m/s² at every speed"
    equation = "-r while moving"
    parameters = (Parameter("resistance_mps2", "m/s²", 0.0, 0.05, 0.3, possible=(0.0, 3.5)),)

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        force = -tensor(self.resistance_mps2)
        if row.measured_speed is None:
            return force * torch.ones_like(x)
        return torch.where(row.speed > 0, force, 0.0)
