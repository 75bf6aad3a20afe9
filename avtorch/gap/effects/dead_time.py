"""Dead time: the command acts after a delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class DeadTime(Effect):
    """`u(t - delay_s)`, exact for delays of any fraction of a step; neutral at 0.

    A held command that arrives late switches within a step. The hook therefore returns two commands and the time for
    which the older one still acts, and the actuator integrates both parts exactly. It is always the last effect of the
    command.

    Possible up to 1.5 s: a radio link of 0.5 s and the air brakes of a long truck, one after the other.

    Example:
        >>> import torch
        >>> from avtorch.gap import DeadTime, SimulatorInput, plant
        >>> time = torch.arange(100, dtype=torch.float64) * 0.05
        >>> step = (time >= 1.0).double()
        >>> accel = plant([DeadTime(0.4)]).response(SimulatorInput(time, step)).accel
        >>> round(time[accel > 1e-9][0].item(), 2)  # the first row after 1.4 s
        1.45
    """

    delay_s: Number = 0.16

    name = "dead_time"
    place = "command"
    order = 9
    shift = "delay_s"
    meaning = "the command acts after a delay"
    words = "commands act {delay_s:.2g} s late"
    equation = "u(t - tau)"
    parameters = (Parameter("delay_s", "s", 0.0, 0.05, 0.5, possible=(0.0, 1.5)),)

    def start(self, x: Tensor, row: EffectContext) -> list[Tensor]:
        return [x]

    def advance(
        self, x: Tensor, row: EffectContext, state: list[Tensor]
    ) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
        delay = tensor(self.delay_s)
        whole, share = self._split(delay, row.dt)
        reach = int(whole.max()) + 2  # this row's command and those still in transit
        kept = [*state, x][-reach:]
        kept = [kept[0]] * (reach - len(kept)) + kept
        if delay.dim() == 0:
            late, early = kept[-1 - int(whole)], kept[-2 - int(whole)]
        else:
            shape = np.broadcast_shapes(x.shape, delay.shape)
            stacked = torch.stack([k.expand(shape) for k in kept])
            index = (reach - 1 - whole.expand(shape))[None]
            late, early = stacked.gather(0, index)[0], stacked.gather(0, index - 1)[0]
        return (early, late, share * row.dt), kept

    def over(self, x: Tensor, row: EffectContext) -> tuple[Tensor, Tensor, Tensor]:
        delay = tensor(self.delay_s)
        if row.dt.dim() and bool(row.dt.min() != row.dt.max()):
            return self._over_jitter(x, row, delay)
        dt = row.dt if row.dt.dim() == 0 else row.dt[..., :1]
        whole, share = self._split(delay, dt)
        index = torch.arange(x.shape[-1]) - whole
        late, early = _rows(x, index), _rows(x, index - 1)
        return early, late, share * dt

    def _split(self, delay: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Whole steps of delay, and the remaining fraction of a step."""
        steps = delay / dt
        whole = (steps + 1e-9).floor()  # 0.2 s is 20 steps of 0.01 s despite round-off in the division
        return whole.detach().long(), (steps - whole.detach()).clamp_min(0.0)

    def _over_jitter(self, x: Tensor, row: EffectContext, delay: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Uneven steps: up to three commands act in one step; the last two are averaged."""
        time, dt = row.time, row.dt
        ends = torch.cat([time[1:], (time[-1] + dt[-1]).reshape(1)])
        first = torch.searchsorted(time.contiguous(), (time - delay).detach().contiguous(), right=True) - 1
        last = len(time) - 1
        until = [ends[(first + i).clamp(0, last)] + delay - time for i in range(2)]
        first_part = torch.minimum(until[0].clamp_min(0.0), dt)
        first_part = torch.where(first < 0, torch.minimum((time[0] + delay - time).clamp_min(0.0), dt), first_part)
        second_part = torch.minimum(until[1].clamp_min(0.0), dt) - first_part
        rest = dt - first_part
        share = torch.where(rest > 0, second_part / torch.where(rest > 0, rest, 1.0), 1.0).clamp(0.0, 1.0)
        late = share * _rows(x, first + 1) + (1 - share) * _rows(x, first + 2)
        return _rows(x, first), late, first_part


def _rows(x: Tensor, index: Tensor) -> Tensor:
    index = index.clamp(0, x.shape[-1] - 1)
    if x.dim() == 1:
        return x[index]
    shape = np.broadcast_shapes(x.shape, index.shape)
    return x.expand(shape).gather(-1, index.expand(shape))
