"""Saturation: the car's acceleration is limited."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class Saturation(Effect):
    """`K u` clipped to `accel_min_mps2 … accel_max_mps2`; neutral at -inf and inf.

    Possible are 0.1 m/s² (drive of a truck) and -0.3 m/s² (drag of a motor) to 12 m/s², the grip of tyres.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, Saturation, plant
        >>> time = torch.arange(800, dtype=torch.float64) * 0.02
        >>> accel = plant([Saturation(accel_max_mps2=1.25)]).response(SimulatorInput(time, 2 * torch.sin(time))).accel
        >>> round(accel.max().item(), 2), round(accel.min().item(), 1)
        (1.25, -1.9)
    """

    accel_max_mps2: Number = 1.25
    accel_min_mps2: Number = -2.5

    name = "saturation"
    place = "command"
    order = 1
    meaning = "commands beyond what drive or brakes can deliver are clipped"
    equation = "K u within [a_min, a_max]"
    parameters = (
        Parameter("accel_max_mps2", "m/s²", float("inf"), 0.8, 2.0, possible=(0.1, 12.0)),
        Parameter("accel_min_mps2", "m/s²", float("-inf"), -4.0, -1.5, "negative", possible=(-12.0, -0.3)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        ends = {"drive gives": values["accel_max_mps2"], "brakes give": values["accel_min_mps2"]}
        told = [f"the {who} at most {abs(end):.2g} m/s²" for who, end in ends.items() if math.isfinite(end)]
        return " and ".join(told) or cls.meaning

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        # clipped before the gain, with limits divided by it, so that a command within them is unchanged to the last bit
        gain = row.K_L.clamp_min(1e-9)
        high, low = tensor(self.accel_max_mps2) / gain, tensor(self.accel_min_mps2) / gain
        return torch.maximum(torch.minimum(x, high), low)

    def accel_limits(self) -> tuple[float, float]:
        return float(self.accel_min_mps2), float(self.accel_max_mps2)
