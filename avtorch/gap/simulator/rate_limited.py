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


def by_rows(
    start: Tensor, parts: Sequence[LimitedSubstep], jerk: tuple[Tensor, Tensor], *, slews: bool = False
) -> Tensor:
    """States (..., time) after each row, from `start` (...): a first-order lag which `jerk`, the most that it rises and
    that it falls, limits; or with `slews` a target that moves to the given one no faster."""
    each = [[x.detach() for x in (p.target, p.lag, p.length)] for p in parts]
    limits = [x.detach().clamp_max(1e9) for x in jerk]
    of_limits = [(*x.shape[:-1], 1) for x in limits]
    shape = np.broadcast_shapes((*start.shape, 1), *of_limits, *(x.shape for p in each for x in p))

    def columns(x: Tensor, time: int) -> FloatArray:
        return x.expand(*shape[:-1], time).reshape(-1, time).numpy()

    rows = np.stack([[columns(x, shape[-1]) for x in p] for p in each])
    first = columns(start.detach()[..., None], 1)[:, 0]
    most = np.stack([columns(x, 1)[:, 0] for x in limits])
    return torch.from_numpy(_limited(first, rows, most, slews)).reshape(shape)


@njit(cache=True, error_model="numpy")
def _limited(
    start: FloatArray, parts: FloatArray, limit: FloatArray, slews: bool
) -> FloatArray:  # pragma: no cover - compiled
    """(column, time) of `parts` (part, 3, column, time): targets, lags and lengths."""
    _, _, columns, rows = parts.shape
    out = np.empty((columns, rows))
    for c in range(columns):
        state, rise, fall = start[c], limit[0, c], limit[1, c]
        for k in range(rows):
            for p in range(parts.shape[0]):
                g, T, h = parts[p, 0, c, k], parts[p, 1, c, k], parts[p, 2, c, k]
                d = g - state
                J = rise if d > 0 else fall
                if slews:
                    state += min(max(d, -J * h), J * h)
                else:  # at the limit while it binds, then exponential
                    at_limit = min(max(abs(d) / J - T, 0.0), h)
                    left = d - np.copysign(J * at_limit, d)
                    state = g - left * np.exp((at_limit - h) / T)
            out[c, k] = state
    return out
