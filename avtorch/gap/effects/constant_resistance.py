"""Constant resistance: rolling resistance, a dragging brake."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.effect import Effect, Row, register
from avtorch.gap.parameter import Parameter
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class ConstantResistance(Effect):
    """`-resistance_mps2` while the car moves; neutral at 0."""

    resistance_mps2: Number = 0.12

    name = "constant_resistance"
    place = "body"
    needs_speed = True
    meaning = "the same deceleration at every speed"
    equation = "-r while moving"
    parameters = (Parameter("resistance_mps2", "m/s²", 0.0, 0.05, 0.3),)

    def apply(self, x: Tensor, row: Row) -> Tensor:
        return torch.where(row.speed > 0, -tensor(self.resistance_mps2), 0.0)
