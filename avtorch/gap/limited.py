"""Rate-limited recursions row by row, in NumPy: a limit that binds for long leaves nothing to parallelise.

The batch is the inner dimension, so a hundred columns cost hardly more than one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Float = NDArray[np.float64]
RowStep = Callable[[Float, Float, Float, Float, Float], Float]


class Held(Protocol):
    """A part of each step: what is aimed at, the lag and the length, (...) or (..., time)."""

    @property
    def target(self) -> Tensor: ...
    @property
    def lag(self) -> Tensor: ...
    @property
    def length(self) -> Tensor: ...


def limited_row(a: Float, g: Float, T: Float, h: Float, J: Float) -> Float:
    """First-order lag with rate limit `J` over `h`: at the limit while it binds, then exponential."""
    d = g - a
    at_limit = np.minimum(np.maximum(np.abs(d) / J - T, 0.0), h)
    left = d - np.copysign(J * at_limit, d)
    return g - left * np.exp((at_limit - h) / T)


def slewed_row(r: Float, g: Float, T: Float, h: Float, J: Float) -> Float:
    """A target slewed at no more than `J`."""
    reach = J * h
    return r + np.minimum(np.maximum(g - r, -reach), reach)


def by_rows(step: RowStep, start: Tensor, parts: Sequence[Held], jerk: Tensor) -> Tensor:
    """States (..., time) after each row, from `start` (...); no derivatives."""
    limit = jerk.detach().clamp_max(1e9)
    shape = np.broadcast_shapes(
        (*start.shape, 1), (*limit.shape[:-1], 1) if limit.dim() else (), *(x.shape for p in parts for x in _tensors(p))
    )
    rows = shape[-1]
    state = start.detach().expand(shape[:-1]).reshape(-1).numpy().copy()
    bound = limit.expand(*shape[:-1], 1).reshape(-1).numpy()
    columns = [[_by_time(x, shape) for x in _tensors(p)] for p in parts]
    out = np.empty((rows, state.size))
    for k in range(rows):
        for target, lag, length in columns:
            state = step(state, target(k), lag(k), length(k), bound)
        out[k] = state
    return torch.as_tensor(np.ascontiguousarray(out.T)).reshape(shape)


def _tensors(part: Held) -> tuple[Tensor, Tensor, Tensor]:
    return part.target.detach(), part.lag.detach(), part.length.detach()


def _by_time(x: Tensor, shape: tuple[int, ...]) -> Any:
    """`at(k)`: values (batch,) at row `k`; what does not change over time is laid out once."""
    if x.dim() == 0 or x.shape[-1] == 1:
        once = x.expand(*shape[:-1], 1).reshape(-1).numpy() if x.dim() else np.asarray(float(x))
        return lambda k: once
    table = np.ascontiguousarray(x.expand(shape).reshape(-1, shape[-1]).numpy().T)
    return table.__getitem__
