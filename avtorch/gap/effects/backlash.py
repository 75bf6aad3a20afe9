"""Backlash: a play that must be crossed before the command moves anything."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


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
