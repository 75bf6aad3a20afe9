"""Brake-throttle asymmetry: brakes and engine have different gain and lag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_ALIKE_RATIOS = 0.05
"""Difference of a ratio from 1 that is not worth a word."""


@register
@dataclass(frozen=True)
class BrakeThrottleAsymmetry(Effect):
    """Gain and lag times `brake_gain_ratio`, `brake_lag_ratio` where the command is negative; neutral at 1, 1.

    Possible are ratios up to five either way for the gain and ten for the lag, as between air brakes and a motor.

    Example:
        >>> import torch
        >>> from avtorch.gap import BrakeThrottleAsymmetry, SimulatorInput, plant
        >>> time = torch.arange(500, dtype=torch.float64) * 0.02
        >>> command = torch.stack([torch.ones(500), -torch.ones(500)]).double()
        >>> car = plant([BrakeThrottleAsymmetry(brake_gain_ratio=0.7)])
        >>> [round(a, 1) for a in car.response(SimulatorInput(time, command)).accel[:, -1].tolist()]
        [1.0, -0.7]
    """

    brake_gain_ratio: Number = 0.7
    brake_lag_ratio: Number = 2.0

    name = "brake_throttle_asymmetry"
    place = "actuator"
    meaning = "gain and lag differ between braking and driving"
    equation = "K_L, T_L times ratios where u < 0"
    parameters = (
        Parameter("brake_gain_ratio", "-", 1.0, 0.5, 0.9, possible=(0.2, 5.0)),
        Parameter("brake_lag_ratio", "-", 1.0, 1.3, 3.0, possible=(0.1, 10.0)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        gain, lag = values["brake_gain_ratio"], values["brake_lag_ratio"]
        told = []
        if abs(gain - 1) >= _ALIKE_RATIOS:
            told.append("weaker" if gain < 1 else "stronger")
        if abs(lag - 1) >= _ALIKE_RATIOS or not told:
            told.append("quicker" if lag < 1 else "slower")
        return f"the brake is {' and '.join(told)} than the throttle"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, Tensor]:
        braking = x < 0
        return (
            torch.where(braking, tensor(self.brake_gain_ratio), 1.0),
            torch.where(braking, tensor(self.brake_lag_ratio), 1.0),
        )
