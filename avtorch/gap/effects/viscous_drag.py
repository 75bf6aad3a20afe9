"""Viscous drag: a resistance in proportion to the speed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class ViscousDrag(Effect):
    """`-drag_per_s v`: bearings, oil, a motor's back electromotive force; neutral at 0.

    Possible up to 1 1/s, a small robot whose motor is shorted; a car's driveline has some 0.005.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, ViscousDrag, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> coasting = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 20.0))
        >>> accel = plant([ViscousDrag(0.01)]).response(coasting).accel
        >>> round(accel[-1].item(), 2)  # m/s²
        -0.2
    """

    drag_per_s: Number = 0.012

    name = "viscous_drag"
    place = "body"
    needs_speed = True
    meaning = "a resistance in proportion to the speed"
    equation = "-c v"
    parameters = (Parameter("drag_per_s", "1/s", 0.0, 0.004, 0.03, possible=(0.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"a drag in proportion to the speed slows the car by {10 * values['drag_per_s']:.2g} m/s² at 10 m/s"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return -tensor(self.drag_per_s) * row.speed
