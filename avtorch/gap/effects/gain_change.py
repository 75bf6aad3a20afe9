"""The gain changes with time: payload, brake fade, a fault."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class GainChange(Effect):
    """`K_L` times `gain_ratio` from `change_s` on, reached over `ramp_s` (near 0: a step); neutral at ratio 1.

    A row takes the mean over its step, so the response is differentiable in the change time.

    Possible are ratios up to five either way: the payload of a truck, brake fade. The change time is unrestricted.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, GainChange, plant
        >>> time = torch.arange(800, dtype=torch.float64) * 0.05
        >>> heavier = plant([GainChange(gain_ratio=0.75, change_s=20.0)])
        >>> accel = heavier.response(SimulatorInput(time, torch.ones_like(time))).accel
        >>> accel[[399, 799]].round(decimals=2).tolist()
        [1.0, 0.75]
    """

    gain_ratio: Number = 0.75
    change_s: Number = 30.0
    ramp_s: Number = 0.0

    name = "gain_change"
    place = "actuator"
    meaning = "the gain changes at some time during the drive"
    equation = "K_L (1 + (ratio - 1) clip((t - t_change) / ramp, 0, 1))"
    own_onset = "change_s"
    of_the_drive = True
    parameters = (
        Parameter("gain_ratio", "-", 1.0, 0.65, 1.4, possible=(0.2, 5.0)),
        Parameter("change_s", "s", None, 0.0, 60.0, "real", possible=(-math.inf, math.inf)),
        Parameter("ramp_s", "s", None, 0.5, 60.0, reported=False),
    )
    settings = (
        Domain("ramp_s", 0.0, 1e6, "s"),
        Domain("change_s", -1e12, 1e12, "s"),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        ratio = values["gain_ratio"]
        return f"the gain {'falls' if ratio < 1 else 'rises'} to {100 * ratio:.0f} % during the drive"

    def apply(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        ramp = tensor(self.ramp_s).clamp_min(1e-6)
        since = row.time - tensor(self.change_s)
        share = (_area(since + row.dt, ramp) - _area(since, ramp)) / row.dt
        return 1 + (tensor(self.gain_ratio) - 1) * share, 1.0


def _area(since: Tensor, ramp: Tensor) -> Tensor:
    """Integral of the ramp up to `since` [s]."""
    within = torch.minimum(since.clamp_min(0.0), ramp)
    return within.square() / (2 * ramp) + (since - ramp).clamp_min(0.0)
