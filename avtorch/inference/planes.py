"""The memory order in which a step of many chains is quickest: one parameter of one window after another.

Shapes stay ``(..., window, parameter)`` everywhere; only the order in memory differs: parameter, then window, then the
chains. Arithmetic on a parameter then runs over contiguous numbers, and what belongs to a window is a single number
there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Float


def to_planes(x: Float[Tensor, "*draw window parameter"]) -> Float[Tensor, "parameter window *draw"]:
    """``(..., window, parameter)`` seen as ``(parameter, window, ...)``, contiguous for what this module makes."""
    return x.permute(-1, -2, *range(x.dim() - 2))


def from_planes(planes: Float[Tensor, "parameter window *draw"]) -> Float[Tensor, "*draw window parameter"]:
    """The inverse of :func:`to_planes`."""
    return planes.permute(*range(2, planes.dim()), 1, 0)


def as_planes(*parameters: Tensor) -> Float[Tensor, "*draw window parameter"]:
    """``(..., window, parameter)`` from one tensor ``(..., window)`` a parameter."""
    return from_planes(torch.stack([parameter.movedim(-1, 0) for parameter in parameters]))


def join_planes(*blocks: Tensor) -> Float[Tensor, "*draw window parameter"]:
    """Blocks ``(..., window, some parameters)`` side by side, ``(..., window, parameter)``."""
    return from_planes(torch.cat([to_planes(block) for block in blocks]))


def empty_planes(
    *shape: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None
) -> Float[Tensor, "*draw window parameter"]:
    """An uninitialised ``(..., window, parameter)``."""
    return from_planes(torch.empty(shape[-1], shape[-2], *shape[:-2], dtype=dtype, device=device))


def lower_times(
    lower: Float[Tensor, "window d d"], x: Float[Tensor, "*draw window d"]
) -> Float[Tensor, "*draw window d"]:
    """``lower @ x`` for triangular ``lower`` ``(window, d, d)`` and ``x`` ``(..., window, d)``."""
    if len(lower) == 1:
        return _product(lower[0], x)
    planes, d = x.unbind(-1), x.shape[-1]
    rows = []
    for i in range(d):
        row = lower[:, i, 0] * planes[0]
        for j in range(1, i + 1):
            row.addcmul_(lower[:, i, j], planes[j])
        rows.append(row)
    return as_planes(*rows)


def lower_transposed_times(
    lower: Float[Tensor, "window d d"], x: Float[Tensor, "*draw window d"]
) -> Float[Tensor, "*draw window d"]:
    """``lower.T @ x``, shapes as in :func:`lower_times`."""
    if len(lower) == 1:
        return _product(lower[0].T, x)
    planes, d = x.unbind(-1), x.shape[-1]
    rows = []
    for i in range(d):
        row = lower[:, i, i] * planes[i]
        for j in range(i + 1, d):
            row.addcmul_(lower[:, j, i], planes[j])
        rows.append(row)
    return as_planes(*rows)


def _product(matrix: Tensor, x: Tensor) -> Tensor:
    """The same matrix ``(d, d)`` for all: one call, where a window's few numbers are soon done with."""
    planes = to_planes(x)
    return from_planes((matrix @ planes.reshape(len(planes), -1)).view(planes.shape))
