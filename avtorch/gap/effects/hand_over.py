"""Hand-over: between drive and brake nothing acts for a while."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_NEVER = -1e9


@register
@dataclass(frozen=True)
class HandOver(Effect):
    """The command is 0 until `pause_s` after its sign has changed; neutral at 0.

    A step of a simulation in which the pause ends has the command for the rest of it, so the response is differentiable
    in the pause. A command of 0 has the sign of the one before.

    Possible up to 2 s: air brakes of a truck, or a lower level that waits before it changes over.

    Example:
        >>> import torch
        >>> from avtorch.gap import HandOver, SimulatorInput, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> braking = SimulatorInput(time, torch.where(time < 4.0, 1.0, -1.0).double())
        >>> accel = plant([HandOver(0.5)]).response(braking).accel
        >>> round(time[accel < 0][0].item(), 2)  # the brake's first row after 4.5 s
        4.6
    """

    pause_s: Number = 0.3

    name = "hand_over"
    place = "command"
    order = 4
    meaning = "nothing acts for a while when the command changes between drive and brake"
    words = "nothing acts for {pause_s:.2g} s between drive and brake"
    equation = "0 for tau after sign(u) has changed, then u"
    parameters = (Parameter("pause_s", "s", 0.0, 0.1, 0.8, possible=(0.0, 2.0)),)

    def start(self, x: Tensor, row: EffectContext) -> Any:
        return torch.sign(x), torch.full_like(x, _NEVER)

    def advance(self, x: Tensor, row: EffectContext, state: Any) -> tuple[Tensor, Any]:
        before, since = state
        own = torch.sign(x)
        since = torch.where(own * before < 0, row.time, since)
        return self._acting(x, since, row), (torch.where(own == 0, before, own), since)

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        index = torch.arange(x.shape[-1])
        own = torch.sign(x.detach())
        signed = torch.where(own != 0, index, 0).cummax(-1).values
        held = own.gather(-1, signed)  # with the sign of the one before where it is 0
        changed = torch.zeros_like(held, dtype=torch.bool)
        changed[..., 1:] = held[..., 1:] * held[..., :-1] < 0
        last = torch.where(changed, index, -1).cummax(-1).values
        time = row.time.expand(x.shape).gather(-1, last.clamp_min(0))
        return self._acting(x, torch.where(last >= 0, time, _NEVER), row)

    def _acting(self, x: Tensor, since: Tensor, row: EffectContext) -> Tensor:
        ends = since + tensor(self.pause_s) - row.time
        return x * (1 - (ends / row.dt).clamp(0.0, 1.0))
