"""Aerodynamic drag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_FAST = 30.0
"""Speed [m/s] at which its size is told."""


@register
@dataclass(frozen=True)
class AerodynamicDrag(Effect):
    """`-drag_per_m (v + wind_mps)²`: drag against the relative wind; neutral at 0. The head wind is fitted with it.

    Possible up to 3e-3 1/m, the value of a cyclist; a car has 2 to 6e-4 (half of rho c_d A / m).

    Example:
        >>> import torch
        >>> from avtorch.gap import AerodynamicDrag, SimulatorInput, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> coasting = SimulatorInput(time, 0 * time, speed=torch.full_like(time, 30.0))
        >>> accel = plant([AerodynamicDrag(4e-4)]).response(coasting).accel
        >>> round(accel[-1].item(), 2)  # 4e-4 times 30²
        -0.36
    """

    drag_per_m: Number = 3.5e-4
    wind_mps: Number = 0.0

    name = "aerodynamic_drag"
    place = "body"
    needs_speed = True
    meaning = "air resistance that the lower level does not compensate"
    equation = "-c (v + w)²"
    parameters = (
        Parameter("drag_per_m", "1/m", 0.0, 2e-4, 6e-4, possible=(0.0, 3e-3)),
        Parameter("wind_mps", "m/s", None, -4.0, 4.0, "real", reported=False),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        force = values["drag_per_m"] * _FAST**2
        return f"air resistance slows the car by {force:.2g} m/s² at {_FAST:.0f} m/s"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        air = row.speed + tensor(self.wind_mps)
        return -tensor(self.drag_per_m) * air * air.abs()
