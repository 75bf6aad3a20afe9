"""Lost messages: the actuator holds the last command that arrived."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.effect import Effect, NoiseChange, Parameter, register
from avtorch.gap.simulator.effect_context import EffectContext
from avtorch.vehicle.arguments import Number, tensor

_ROWS_BACK = 12  # older commands have a weight of 0.5^12 at most, at a loss fraction of 0.5


@register
@dataclass(frozen=True)
class CommandHold(Effect):
    """Each row's command is lost with probability `hold_fraction`, and the last one that arrived is held; neutral at 0.

    Random: its deterministic response is zero; it changes the noise of the command, which is large where the command
    moves.

    Possible up to 0.6: a link that drops more acts as a slower link, not as a random one.

    Example:
        >>> import torch
        >>> from avtorch.gap import CommandHold
        >>> u = torch.sin(torch.arange(100, dtype=torch.float64))
        >>> spread = [CommandHold(p).noise(u).command_variance.mean().sqrt().item() for p in (0.0, 0.07)]
        >>> [round(x, 2) for x in spread]  # what acts differs so much from what was sent [m/s²]
        [0.0, 0.19]
    """

    hold_fraction: Number = 0.07

    name = "command_hold"
    place = "command"
    meaning = "messages are lost and the last command is held"
    equation = "u of the last row that arrived"
    parameters = (
        Parameter(
            "hold_fraction", "-", 0.0, 0.02, 0.2, "unit", possible=(0.0, 0.6), beyond="no link loses so many messages"
        ),
    )

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

    def noise(self, u: Tensor) -> NoiseChange:
        """Mean square of `u` acting minus `u` logged: `sum_j (1 - p) p^j (u[k-j] - u[k])²`."""
        p = tensor(self.hold_fraction).unsqueeze(-1)
        total = torch.zeros(np.broadcast_shapes(u.shape, p.shape), dtype=u.dtype)
        for j in range(1, min(_ROWS_BACK, u.shape[-1] - 1) + 1):
            older = torch.cat([u[..., :1].expand(*u.shape[:-1], j), u[..., :-j]], -1)
            total = total + (1 - p) * p**j * (older - u).square()
        return NoiseChange(command_variance=total)
