"""The memory order in which one step of many chains is quickest: one plane ``(chain, window)`` after another.

Shapes stay ``(..., window, parameter)`` everywhere; only the order in memory differs, so that arithmetic on a single
parameter runs over contiguous numbers. On 64 chains of 1000 windows a step takes a fifth of the time.
"""

from __future__ import annotations

import torch
from torch import Tensor


def as_planes(*parameters: Tensor) -> Tensor:
    """``(..., parameter)`` from one tensor ``(...)`` a parameter."""
    return torch.stack(parameters).movedim(0, -1)


def join_planes(*blocks: Tensor) -> Tensor:
    """Blocks ``(..., some parameters)`` side by side, ``(..., parameter)``."""
    return torch.cat([block.movedim(-1, 0) for block in blocks]).movedim(0, -1)


def empty_planes(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """An uninitialised ``(..., parameter)``."""
    return torch.empty(shape[-1], *shape[:-1], dtype=dtype).movedim(0, -1)


def lower_times(lower: Tensor, x: Tensor) -> Tensor:
    """``lower @ x`` for triangular ``lower`` ``(window, d, d)`` and ``x`` ``(..., window, d)``."""
    planes, d = x.unbind(-1), x.shape[-1]
    rows = []
    for i in range(d):
        row = lower[:, i, 0] * planes[0]
        for j in range(1, i + 1):
            row.addcmul_(lower[:, i, j], planes[j])
        rows.append(row)
    return as_planes(*rows)


def lower_transposed_times(lower: Tensor, x: Tensor) -> Tensor:
    """``lower.T @ x``, shapes as in :func:`lower_times`."""
    planes, d = x.unbind(-1), x.shape[-1]
    rows = []
    for i in range(d):
        row = lower[:, i, i] * planes[i]
        for j in range(i + 1, d):
            row.addcmul_(lower[:, j, i], planes[j])
        rows.append(row)
    return as_planes(*rows)
