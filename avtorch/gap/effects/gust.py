"""Gusts: a slowly coloured random acceleration of the body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, NoiseChange, Parameter, register
from avtorch.gap.simulator.recursion import scan
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class Gust(Effect):
    """Ornstein-Uhlenbeck acceleration of standard deviation `sd_mps2` and `time_constant_s`, stationary; neutral at 0.

    Random: its deterministic response is zero; the noise model gains this force in both channels.

    Possible up to 0.6 m/s², the pull of unmodelled grades of 6 % (root mean square); a storm with a wind SD of 10 m/s
    causes 0.2 m/s² at 30 m/s. A time constant below 0.2 s is vibration, one above a minute is drift.

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, Gust, plant
        >>> time = torch.arange(2000, dtype=torch.float64) * 0.05
        >>> windy, drive = plant([Gust(sd_mps2=0.2)]), SimulatorInput(time, 0 * time, speed=torch.full_like(time, 20.0))
        >>> accel = windy.response(drive, generator=torch.Generator().manual_seed(0)).accel
        >>> windy.response(drive).accel.std().item(), round(accel.std().item(), 1)  # the mean response, and one drawn
        (0.0, 0.2)
    """

    sd_mps2: Number = 0.2
    time_constant_s: Number = 2.2

    name = "gust"
    place = "body"
    meaning = "wind and road push the car at random, for seconds"
    words = "wind and road push the car at random by {sd_mps2:.2g} m/s²"
    equation = "df = -f / tau dt + sd sqrt(2 / tau) dW"
    parameters = (
        Parameter("sd_mps2", "m/s²", 0.0, 0.1, 0.4, possible=(0.0, 0.6)),
        Parameter("time_constant_s", "s", None, 1.0, 5.0, possible=(0.2, 60.0)),
    )

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        if row.normal is None:
            return torch.zeros_like(x), None
        sd = tensor(self.sd_mps2)
        if state is None:
            force = sd * row.normal
        else:
            before, dt = state
            keep = torch.exp(-dt / tensor(self.time_constant_s))
            force = keep * before + sd * torch.sqrt(1 - keep.square()) * row.normal
        return force, (force, row.dt)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        if row.normal is None:
            return torch.zeros_like(x)
        sd, dt = tensor(self.sd_mps2), row.dt.expand(row.time.shape)[..., :-1]
        keep = torch.exp(-dt / tensor(self.time_constant_s))
        first = sd[..., 0] * row.normal[..., 0] if sd.dim() else sd * row.normal[..., 0]
        later = scan(keep, sd * torch.sqrt(1 - keep.square()) * row.normal[..., 1:], first)
        return torch.cat([first.expand(later.shape[:-1])[..., None], later], -1)

    def noise(self, u: Tensor) -> NoiseChange:
        return NoiseChange(force_sd=tensor(self.sd_mps2), force_time=tensor(self.time_constant_s))
