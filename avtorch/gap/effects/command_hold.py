"""Lost messages: the actuator holds the last command that arrived."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor


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
