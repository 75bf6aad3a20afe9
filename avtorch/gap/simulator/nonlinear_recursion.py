"""Nonlinear recursions over time, all rows at once: x[k] = f_k(x[k-1]).

Newton's method on the whole drive: linearise every row at the guess, solve the linear recursion by a scan, repeat (Lim
et al. 2024, "Parallelizing non-linear sequential models over the sequence length"). After n rounds the first n rows are
exact for any f; where f is piecewise smooth with slopes in 0 … 1, a few rounds suffice for all.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from avtorch.gap.simulator.recursion import scan

Step = Callable[[Tensor, slice], tuple[Tensor, Tensor]]
"""`step(x_before (..., row), rows) -> (x (..., row), slope (..., row))` for the given rows."""


def solve(
    step: Step, start: Tensor, guess: Tensor, *, tolerance: float = 1e-13, rounds: int = 40, settle: bool = True
) -> Tensor:
    """`x` (..., time) with `x[-1] = start` (...), from a `guess` (..., time), to `tolerance` times its size.

    Rows that have not converged after the last round are stepped one by one, which is slow but exact (`settle` False:
    they are left as they are, for a guess). First derivatives flow to `start` and to whatever `step` depends on; there
    are no second ones.
    """
    whole = slice(0, guess.shape[-1])
    with torch.no_grad():
        x = guess.expand(torch.broadcast_shapes(guess.shape, (*start.shape, 1)))
        for _ in range(rounds):
            before = _before(start, x)
            value, slope = step(before, whole)
            new = scan(slope, value - slope * before, start)
            change = float((new - x).abs().max())
            x = new
            if change <= tolerance * (1 + float(x.abs().max())):
                break
        else:
            x = _row_by_row(step, start, x) if settle else x
        before = _before(start, x)
    value, slope = step(before, whole)
    slope = slope.detach()
    return scan(slope, value - slope * before, start)


def _before(start: Tensor, x: Tensor) -> Tensor:
    return torch.cat([start.detach().expand(x.shape[:-1])[..., None], x[..., :-1]], -1)


def _row_by_row(step: Step, start: Tensor, x: Tensor) -> Tensor:
    rows, state = [], start.detach().expand(x.shape[:-1])[..., None]
    for k in range(x.shape[-1]):
        state, _ = step(state, slice(k, k + 1))
        rows.append(state)
    return torch.cat(rows, -1)
