"""Backlash: a play that must be crossed before the command moves anything."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, Parameter, register
from avtorch.gap.simulator.effect_context import EffectContext
from avtorch.vehicle.arguments import Number, tensor


@register
@dataclass(frozen=True)
class Backlash(Effect):
    """Play operator of `half_width_mps2`: the output follows `u` at that distance; neutral at 0.

    Each row clamps the last output to `u ± half width`. A composition of clamps is a clamp, so whole drives are scanned
    in blocks. The scan identifies the rows that moved; their output is `u ± half width`, which is differentiable.

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
    parameters = (
        Parameter(
            "half_width_mps2", "m/s²", 0.0, 0.02, 0.3, possible=(0.0, 1.0), beyond="no driveline has that much play"
        ),
    )

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
        low, high = x - width, x + width
        with torch.no_grad():
            y = _clamped(low, high, x[..., 0])
            before = torch.cat([x[..., :1].expand_as(y[..., :1]), y[..., :-1]], -1)
            # rising rows lie on the lower edge, falling ones on the upper; the others repeat the last row that moved
            side = torch.sign(y - before)
            last = torch.where(side != 0, torch.arange(x.shape[-1]), 0).cummax(-1).values
            side = side.gather(-1, last)
        return x.expand_as(last).gather(-1, last) - side * width


def _clamped(low: Tensor, high: Tensor, start: Tensor) -> Tensor:
    """`y[k] = clamp(y[k-1], low[k], high[k])` along the last dimension, by blocks of about sqrt(N) rows."""
    steps = low.shape[-1]
    start = start.expand(low.shape[:-1])
    if steps <= 32:
        rows = []
        for k in range(steps):
            start = torch.maximum(low[..., k], torch.minimum(high[..., k], start))
            rows.append(start)
        return torch.stack(rows, -1)
    length = math.isqrt(steps - 1) + 1
    blocks = -(-steps // length)
    lows = _cut(low, blocks, length, float("-inf"))
    highs = _cut(high, blocks, length, float("inf"))
    bottom, top = lows[0], highs[0]
    bottoms, tops = [bottom], [top]
    for k in range(1, length):
        bottom = torch.maximum(lows[k], torch.minimum(highs[k], bottom))
        top = torch.maximum(lows[k], torch.minimum(highs[k], top))
        bottoms.append(bottom)
        tops.append(top)
    ends = _clamped(bottom, top, start)
    inherited = torch.cat([start[..., None], ends[..., :-1]], -1)
    y = torch.maximum(torch.stack(bottoms), torch.minimum(torch.stack(tops), inherited))
    return y.movedim(0, -1).reshape(*low.shape[:-1], blocks * length)[..., :steps]


def _cut(x: Tensor, blocks: int, length: int, fill: float) -> tuple[Tensor, ...]:
    x = torch.nn.functional.pad(x, (0, blocks * length - x.shape[-1]), value=fill)
    return x.reshape(*x.shape[:-1], blocks, length).movedim(-1, 0).contiguous().unbind(0)
