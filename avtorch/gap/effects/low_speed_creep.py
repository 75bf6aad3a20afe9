"""Creep: at low speed an idling engine pushes the car."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_FADES_OVER = 0.5  # [m/s]


@register
@dataclass(frozen=True)
class LowSpeedCreep(Effect):
    """`creep_mps2` below about `fades_at_mps`, fading smoothly there; neutral at 0. Where it fades is fitted with it.

    Possible up to 1.5 m/s²: the full stall torque of a converter.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, LowSpeedCreep, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> speed = torch.tensor([[0.5], [20.0]], dtype=torch.float64).expand(2, 100)
        >>> accel = plant([LowSpeedCreep(0.22)]).response(SimulatorInput(time, 0 * speed, speed=speed)).accel
        >>> accel[:, -1].round(decimals=1).tolist()
        [0.2, 0.0]
    """

    creep_mps2: Number = 0.22
    fades_at_mps: Number = 3.0

    name = "low_speed_creep"
    place = "body"
    needs_speed = True
    meaning = "the car is pushed forward at walking speed"
    words = "the car is pushed forward by {creep_mps2:.2g} m/s² at walking speed"
    equation = "creep / (1 + exp((v - v_f) / 0.5))"
    parameters = (
        Parameter("creep_mps2", "m/s²", 0.0, 0.1, 0.5, possible=(0.0, 1.5)),
        Parameter("fades_at_mps", "m/s", None, 1.5, 4.5, possible=(0.5, 8.0), reported=False),
    )

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        return tensor(self.creep_mps2) * torch.sigmoid((tensor(self.fades_at_mps) - row.speed) / _FADES_OVER)
