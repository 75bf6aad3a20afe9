"""Rate-limited recursions row by row, in NumPy, with many stretches of the drive in parallel.

Each stretch first starts at its target, then at the end of the previous one, until that no longer changes: a lag
forgets its initial state, so a few passes suffice. Where a limit binds for long the initial state is not forgotten and
more passes are needed, at worst as many as stretches. The batch is the inner dimension, so a hundred columns cost
hardly more than one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray

RowStep = Callable[[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]

_STRETCHES, _SHORTEST = 128, 128  # rows of the shortest stretch
_SAME = 1e-13  # [m/s²]


class LimitedSubstep(Protocol):
    """A part of each step: its target, lag and length, (...) or (..., time)."""

    @property
    def target(self) -> Tensor: ...
    @property
    def lag(self) -> Tensor: ...
    @property
    def length(self) -> Tensor: ...


def limited_row(a: FloatArray, g: FloatArray, T: FloatArray, h: FloatArray, J: FloatArray) -> FloatArray:
    """First-order lag with rate limit `J` over `h`: at the limit while it binds, then exponential."""
    d = g - a
    at_limit = np.minimum(np.maximum(np.abs(d) / J - T, 0.0), h)
    left = d - np.copysign(J * at_limit, d)
    return g - left * np.exp((at_limit - h) / T)


def slewed_row(r: FloatArray, g: FloatArray, T: FloatArray, h: FloatArray, J: FloatArray) -> FloatArray:
    """A target slewed at no more than `J`."""
    reach = J * h
    return r + np.minimum(np.maximum(g - r, -reach), reach)


def by_rows(step: RowStep, start: Tensor, parts: Sequence[LimitedSubstep], jerk: Tensor) -> Tensor:
    """States (..., time) after each row, from `start` (...); no derivatives."""
    limit = jerk.detach().clamp_max(1e9)
    shape = np.broadcast_shapes(
        (*start.shape, 1), (*limit.shape[:-1], 1) if limit.dim() else (), *(x.shape for p in parts for x in _tensors(p))
    )
    rows = shape[-1]
    size = min(rows, max(_SHORTEST, int(np.ceil(rows / _STRETCHES))))
    count = -(-rows // size)
    first = start.detach().expand(shape[:-1]).reshape(-1).numpy()
    bound = limit.expand(*shape[:-1], 1).reshape(-1).numpy()
    columns = [[_by_time(x, shape, count, size) for x in _tensors(p)] for p in parts]
    begin = np.array(np.broadcast_to(columns[0][0](0), (count, first.size)))
    out = np.full((size, count, first.size), np.nan)
    while True:
        begin[0] = first
        state = begin
        for k in range(size):
            for target, lag, length in columns:
                state = step(state, target(k), lag(k), length(k), bound)
            known = np.abs(state - out[k]).max() <= _SAME
            out[k] = state
            if known:  # and so are the rows that follow
                break
        ends = np.concatenate([first[None], out[-1, :-1]])
        if np.abs(ends - begin).max() <= _SAME:
            break
        begin = ends
    whole = np.ascontiguousarray(out.transpose(2, 1, 0)).reshape(first.size, -1)[:, :rows]
    return torch.as_tensor(np.ascontiguousarray(whole)).reshape(shape)


def _tensors(part: LimitedSubstep) -> tuple[Tensor, Tensor, Tensor]:
    return part.target.detach(), part.lag.detach(), part.length.detach()


def _by_time(x: Tensor, shape: tuple[int, ...], count: int, size: int) -> Any:
    """`at(k)`: values (stretch, batch) at row `k` of each; what is constant over time is stored once."""
    if x.dim() == 0 or x.shape[-1] == 1:
        once = x.expand(*shape[:-1], 1).reshape(-1).numpy() if x.dim() else np.asarray(float(x))
        return lambda k: once
    table = x.expand(shape).reshape(-1, shape[-1]).numpy()
    table = np.pad(table, ((0, 0), (0, count * size - shape[-1])), mode="edge").reshape(-1, count, size)
    return np.ascontiguousarray(table.transpose(2, 1, 0)).__getitem__
