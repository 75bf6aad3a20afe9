"""Rate-limited recursions row by row, in NumPy, with many stretches of the drive in parallel.

Each stretch first starts at its target, then where Newton's method on the starts of all stretches puts it: the slope of
a stretch's end by its start is the product of its rows'. Ends are piecewise smooth with slopes in 0 … 1, so a few
passes suffice; after n of them the first n stretches are exact in any case. The batch is the inner dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.simulator.recursion import scan

RowStep = Callable[[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""`step(state, target, lag, length, limit) -> (state after it, its slope by the state before)`."""

_STRETCHES, _SHORTEST = 1024, 32  # rows of the shortest stretch
_SAME = 1e-13  # [m/s²]


class LimitedSubstep(Protocol):
    """A part of each step: its target, lag and length, (...) or (..., time)."""

    @property
    def target(self) -> Tensor: ...
    @property
    def lag(self) -> Tensor: ...
    @property
    def length(self) -> Tensor: ...


def limited_row(
    a: FloatArray, g: FloatArray, T: FloatArray, h: FloatArray, J: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """First-order lag with rate limit `J` over `h`: at the limit while it binds, then exponential."""
    d = g - a
    at_limit = np.minimum(np.maximum(np.abs(d) / J - T, 0.0), h)
    left = d - np.copysign(J * at_limit, d)
    slope = np.exp((at_limit - h) / T)
    return g - left * slope, slope


def slewed_row(
    r: FloatArray, g: FloatArray, T: FloatArray, h: FloatArray, J: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A target slewed at no more than `J`."""
    reach = J * h
    moved = np.minimum(np.maximum(g - r, -reach), reach)
    return r + moved, np.where(moved == g - r, 0.0, 1.0)


@torch.inference_mode()
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
    begin[0] = first
    out = np.empty((size, count, first.size))
    while True:
        state, slope = begin, np.ones_like(begin)
        for k in range(size):
            for target, lag, length in columns:
                state, own = step(state, target(k), lag(k), length(k), bound)
                slope = slope * own
            out[k] = state
        if np.abs(state[:-1] - begin[1:]).max(initial=0.0) <= _SAME:
            break
        ends, slopes = (x[:-1].T for x in (state - slope * begin, slope))
        begin[1:] = scan(torch.as_tensor(slopes), torch.as_tensor(ends), torch.as_tensor(first)).numpy().T
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
