"""Rate limit: the realised acceleration changes at a limited rate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_ALIKE_LIMITS = 0.1
"""Of the logarithms of both limits: what is not worth a word."""


@register
@dataclass(frozen=True)
class RateLimit(Effect):
    """`da/dt` of the actuator at most `jerk_max_mps3`, where it falls `fall_ratio` times that; neutral at infinity.

    Behind a second-order actuator the set-point `K u` is slewed instead, with the same limits.

    Possible are 0.1 m/s³ (ten seconds to a gentle acceleration) to 50 m/s³ (an emergency brake).

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, RateLimit, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.02
        >>> step = SimulatorInput(time, 2 * (time >= 0.5).double())
        >>> accel = plant([RateLimit(jerk_max_mps3=1.4)]).response(step).accel
        >>> round((accel.diff() / 0.02).max().item(), 2)  # m/s³
        1.4
    """

    jerk_max_mps3: Number = 1.4
    fall_ratio: Number = 1.0

    name = "rate_limit"
    place = "actuator"
    order = 2
    meaning = "the actuator's jerk is bounded"
    equation = "da/dt = (K u - a) / T_L from -fall_ratio jerk_max to jerk_max"
    parameters = (
        Parameter("jerk_max_mps3", "m/s³", float("inf"), 0.5, 4.0, possible=(0.1, 50.0)),
        Parameter("fall_ratio", "-", None, 0.4, 2.5, possible=(0.05, 20.0)),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        rise, fall = values["jerk_max_mps3"], values["jerk_max_mps3"] * values.get("fall_ratio", 1.0)
        if abs(math.log(fall / rise)) < _ALIKE_LIMITS:
            return f"the acceleration changes by at most {rise:.2g} m/s³"
        return f"the acceleration rises by at most {rise:.2g} m/s³ and falls by at most {fall:.2g} m/s³"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[float, float]:
        return 1.0, 1.0  # the limit is applied in the actuator, see `actuator.py`

    def actuator_parameters(self) -> Mapping[str, Tensor]:
        return {"jerk": tensor(self.jerk_max_mps3), "fall": tensor(self.fall_ratio)}
