"""Effects on the command, before it reaches the actuator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
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


@register
@dataclass(frozen=True)
class DeadBand(Effect):
    """Soft threshold of `|u|` at `half_width_mps2`; neutral at 0.

    Possible up to 1 m/s², an eighth of full braking.

    Example:
        >>> import torch
        >>> from avtorch.gap import DeadBand, SimulatorInput, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> command = torch.tensor([[0.05], [0.5]], dtype=torch.float64).expand(2, 200)  # a faint and a firm command
        >>> accel = plant([DeadBand(0.08)]).response(SimulatorInput(time, command)).accel
        >>> accel[:, -1].round(decimals=2).tolist()
        [0.0, 0.42]
    """

    half_width_mps2: Number = 0.08

    name = "dead_band"
    place = "command"
    order = 2
    meaning = "commands within a band do nothing, larger ones are reduced by its half width"
    equation = "sign(u) max(|u| - delta, 0)"
    parameters = (Parameter("half_width_mps2", "m/s²", 0.0, 0.02, 0.3, possible=(0.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"commands of less than {values['half_width_mps2']:.2g} m/s² do nothing"

    def apply(self, x: Tensor, row: EffectContext) -> Tensor:
        width = tensor(self.half_width_mps2)
        return (x - width).clamp_min(0.0) + (x + width).clamp_max(0.0)


@register
@dataclass(frozen=True)
class Backlash(Effect):
    """Play operator of `half_width_mps2`: the output follows `u` at that distance; neutral at 0.

    Of a whole drive the rows that moved are found first; their output is `u ± half width`, which is differentiable.

    Possible up to 1 m/s²: no driveline or pedal has more play.

    Example:
        >>> import torch
        >>> from avtorch.gap import Backlash, SimulatorInput, plant
        >>> time = torch.arange(600, dtype=torch.float64) * 0.02
        >>> accel = plant([Backlash(0.3)]).response(SimulatorInput(time, torch.sin(time))).accel
        >>> round(accel.max().item(), 1)  # the play of 0.3 m/s² is missing at the top
        0.7
    """

    half_width_mps2: Number = 0.08

    name = "backlash"
    place = "command"
    order = 3
    meaning = "a play is crossed whenever the command turns back"
    equation = "y = max(u - beta, min(u + beta, y of the row before))"
    parameters = (Parameter("half_width_mps2", "m/s²", 0.0, 0.02, 0.3, possible=(0.0, 1.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"a play of {2 * values['half_width_mps2']:.2g} m/s² is crossed whenever the command turns back"

    def start(self, x: Tensor, row: EffectContext) -> Tensor:
        return x

    def advance(self, x: Tensor, row: EffectContext, state: Tensor) -> tuple[Tensor, Tensor]:
        width = tensor(self.half_width_mps2)
        y = torch.maximum(x - width, torch.minimum(x + width, state))
        return y, y

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        width = tensor(self.half_width_mps2)
        shape = np.broadcast_shapes(x.shape, width.shape)
        columns, widths = (e.detach().expand(shape).reshape(-1, shape[-1]).contiguous() for e in (x, width))
        moved = _last_moved(columns.numpy(), widths.numpy())
        last, side = (torch.from_numpy(e).reshape(shape) for e in moved)
        return x.expand(shape).gather(-1, last) - side * width


@njit(cache=True)
def _last_moved(x: FloatArray, width: FloatArray) -> tuple[IntArray, FloatArray]:  # pragma: no cover - compiled
    """Row (column, time) in which the output has moved last, and the edge of the play that it lies on since: 1 where
    it has risen, -1 where it has fallen, 0 before it moves."""
    last, side = np.zeros(x.shape, np.int64), np.zeros(x.shape)
    for c in range(len(x)):
        y, row, edge = x[c, 0], 0, 0.0
        for k in range(x.shape[1]):
            low, high = x[c, k] - width[c, k], x[c, k] + width[c, k]
            if y < low:
                y, row, edge = low, k, 1.0
            elif y > high:
                y, row, edge = high, k, -1.0
            last[c, k], side[c, k] = row, edge
    return last, side


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
    equation = "0 for tau after sign(u) has changed, then u"
    parameters = (Parameter("pause_s", "s", 0.0, 0.1, 0.8, possible=(0.0, 2.0)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"nothing acts for {values['pause_s']:.2g} s between drive and brake"

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


@register
@dataclass(frozen=True)
class CommandHold(Effect):
    """Each row's command is lost with probability `hold_fraction`, and the last one that arrived is held; neutral at 0.

    Random: its deterministic response is zero.

    Possible up to 0.6: a link that drops more acts as a slower link, not as a random one.

    Example:
        >>> import torch
        >>> from avtorch.gap import CommandHold, SimulatorInput, plant
        >>> time = torch.arange(2000, dtype=torch.float64) * 0.05
        >>> drive, lossy = SimulatorInput(time, torch.sin(time)), plant([CommandHold(0.07)])
        >>> late = lossy.response(drive, generator=torch.Generator().manual_seed(0)).accel
        >>> bool((late != lossy.response(drive).accel).any())  # one drawn, and the mean response
        True
    """

    hold_fraction: Number = 0.07

    name = "command_hold"
    place = "command"
    random = True
    meaning = "messages are lost and the last command is held"
    equation = "u of the last row that arrived"
    parameters = (Parameter("hold_fraction", "-", 0.0, 0.02, 0.2, "unit", possible=(0.0, 0.6)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"{100 * values['hold_fraction']:.2g} % of the commands are lost and the last one is held"

    def start(self, x: Tensor, row: EffectContext) -> Tensor:
        return x

    def advance(self, x: Tensor, row: EffectContext, state: Tensor) -> tuple[Tensor, Tensor]:
        if row.normal is None:
            return x, x
        y = torch.where(self._lost(row.normal), state, x)
        return y, y

    def over(self, x: Tensor, row: EffectContext) -> Tensor:
        if row.normal is None:
            return x
        arrived = ~self._lost(row.normal)
        rows = torch.arange(x.shape[-1])
        last = torch.where(arrived, rows, 0).cummax(-1).values
        shape = np.broadcast_shapes(last.shape, x.shape)
        return x.expand(shape).gather(-1, last.expand(shape))

    def _lost(self, normal: Tensor) -> Tensor:
        return torch.special.ndtr(normal) < tensor(self.hold_fraction)


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
    equation = "u(t - tau)"
    parameters = (Parameter("delay_s", "s", 0.0, 0.05, 0.5, possible=(0.0, 1.5)),)

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"commands act {values['delay_s']:.2g} s late"

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
