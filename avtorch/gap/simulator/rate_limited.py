"""Rate-limited recursions row by row, in compiled code, without derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray


class LimitedSubstep(Protocol):
    """A part of each step: its target, lag and length, (...) or (..., time)."""

    @property
    def target(self) -> Tensor: ...
    @property
    def lag(self) -> Tensor: ...
    @property
    def length(self) -> Tensor: ...


def by_rows(start: Tensor, parts: Sequence[LimitedSubstep], jerk: Tensor, *, slews: bool = False) -> Tensor:
    """States (..., time) after each row, from `start` (...): a first-order lag whose rate is limited by `jerk`, or with
    `slews` a target that moves to the given one no faster."""
    each = [[x.detach() for x in (p.target, p.lag, p.length)] for p in parts]
    limit = jerk.detach().clamp_max(1e9)
    shape = np.broadcast_shapes((*start.shape, 1), (*limit.shape[:-1], 1), *(x.shape for p in each for x in p))

    def columns(x: Tensor, time: int) -> FloatArray:
        return x.expand(*shape[:-1], time).reshape(-1, time).numpy()

    rows = np.stack([[columns(x, shape[-1]) for x in p] for p in each])
    first = columns(start.detach()[..., None], 1)[:, 0]
    return torch.from_numpy(_limited(first, rows, columns(limit, 1)[:, 0], slews)).reshape(shape)


@njit(cache=True, error_model="numpy")
def _limited(
    start: FloatArray, parts: FloatArray, limit: FloatArray, slews: bool
) -> FloatArray:  # pragma: no cover - compiled
    """(column, time) of `parts` (part, 3, column, time): targets, lags and lengths."""
    _, _, columns, rows = parts.shape
    out = np.empty((columns, rows))
    for c in range(columns):
        state, J = start[c], limit[c]
        for k in range(rows):
            for p in range(parts.shape[0]):
                g, T, h = parts[p, 0, c, k], parts[p, 1, c, k], parts[p, 2, c, k]
                d = g - state
                if slews:
                    state += min(max(d, -J * h), J * h)
                else:  # at the limit while it binds, then exponential
                    at_limit = min(max(abs(d) / J - T, 0.0), h)
                    left = d - np.copysign(J * at_limit, d)
                    state = g - left * np.exp((at_limit - h) / T)
            out[c, k] = state
    return out
