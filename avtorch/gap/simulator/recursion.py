"""Linear recursions over time, row by row in compiled code.

    x[k] = alpha[k] x[k-1] + beta[k],    x[-1] = start

The gradient of a linear recursion is a linear recursion, transposed and run backward in time, hence derivatives of any
order. `scan` takes a scalar state, `scan_pair` a state of two components with 2 x 2 matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray

_Components = list[Tensor]


def scan(alpha: Tensor, beta: Tensor, start: Tensor) -> Tensor:
    """`x` (..., time) of the recursion above.

    Args: `alpha` (..., time), or (..., 1) where it is constant, `beta` (..., time), `start` (...). All broadcast.

    Example:
        >>> import torch
        >>> from avtorch.gap import scan
        >>> alpha, beta = torch.tensor([0.5]), torch.ones(4)
        >>> scan(alpha, beta, start=torch.tensor(0.0)).tolist()  # x[k] = 0.5 x[k-1] + 1
        [1.0, 1.5, 1.75, 1.875]
    """
    return _Scan.apply(*_aligned(1, [alpha], [beta], [start]))[0]


def scan_pair(
    matrix: tuple[Tensor, Tensor, Tensor, Tensor], beta: tuple[Tensor, Tensor], start: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """The two components (..., time) of `x[k] = A[k] x[k-1] + beta[k]`, `A = [[m0, m1], [m2, m3]]`.

    Args: `matrix` four of (..., time) or (..., 1), `beta` two of (..., time), `start` two of (...). All broadcast.
    """
    first, second = _Scan.apply(*_aligned(2, list(matrix), list(beta), list(start)))
    return first, second


def _aligned(n: int, alpha: _Components, beta: _Components, start: _Components) -> list[Any]:
    """All inputs with one batch shape, and one length of time for each kind."""
    start = [s.unsqueeze(-1) for s in start]
    shape = np.broadcast_shapes(*(x.shape[:-1] for x in (*alpha, *beta, *start)))
    steps = max(x.shape[-1] for x in (*alpha, *beta))
    constant = all(a.shape[-1] == 1 for a in alpha)
    alpha = [a.expand(*shape, 1 if constant else steps) for a in alpha]
    return [n, *alpha, *(b.expand(*shape, steps) for b in beta), *(s.expand(*shape, 1) for s in start)]


class _Scan(torch.autograd.Function):
    """Inputs: n, n² of alpha, n of beta, n of start (…, 1); outputs: n of x (…, time)."""

    @staticmethod
    def forward(ctx: Any, n: int, *parts: Tensor) -> tuple[Tensor, ...]:
        shape, dtype = parts[n * n].shape, parts[n * n].dtype
        alpha, beta, start = (
            np.stack([x.detach().double().reshape(shape[:-1].numel(), x.shape[-1]).numpy() for x in some])
            for some in _split(n, parts)
        )
        x = tuple(torch.from_numpy(each).reshape(shape).to(dtype) for each in _stepped(alpha, beta, start[..., 0]))
        ctx.n = n
        ctx.save_for_backward(*parts, *x)
        return x

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        n = ctx.n
        saved = ctx.saved_tensors
        (alpha, _, start), x = _split(n, saved[:-n]), saved[-n:]
        constant = alpha[0].shape[-1] == 1
        # co-state c[k] = grad[k] + A[k+1]ᵀ c[k+1]: the same recursion, transposed and run backward
        transposed = [alpha[j * n + i] for i in range(n) for j in range(n)]
        if not constant:
            transposed = [torch.cat([a[..., :1], a[..., 1:].flip(-1)], -1) for a in transposed]
        zero = [torch.zeros_like(s) for s in start]
        costate = [c.flip(-1) for c in _Scan.apply(n, *transposed, *(g.flip(-1) for g in grads), *zero)]
        before = [torch.cat([s, xi[..., :-1]], -1) for s, xi in zip(start, x, strict=True)]
        need = ctx.needs_input_grad[1:]
        on_alpha: list[Tensor | None] = []
        for i in range(n):
            for j in range(n):
                if not need[i * n + j]:
                    on_alpha.append(None)
                    continue
                product = costate[i] * before[j]
                on_alpha.append(product.sum(-1, keepdim=True) if constant else product)
        on_start = [sum(alpha[j * n + i][..., :1] * costate[j][..., :1] for j in range(n)) for i in range(n)]
        return (None, *on_alpha, *costate, *on_start)  # type: ignore[return-value]


def _split(n: int, parts: Sequence[Tensor]) -> tuple[_Components, _Components, _Components]:
    return list(parts[: n * n]), list(parts[n * n : n * n + n]), list(parts[n * n + n : n * n + 2 * n])


@njit(cache=True, error_model="numpy")
def _stepped(alpha: FloatArray, beta: FloatArray, start: FloatArray) -> FloatArray:  # pragma: no cover - compiled
    """`x` (component, column, time) from `alpha` (n², column, time or 1), `beta` alike, `start` (component, column)."""
    n, columns, steps = beta.shape
    constant = alpha.shape[2] == 1
    out = np.empty_like(beta)
    for c in range(columns):
        x, y = start[0, c], start[n - 1, c]
        for k in range(steps):
            at = 0 if constant else k
            if n == 1:
                x = alpha[0, c, at] * x + beta[0, c, k]
            else:
                before = x
                x = alpha[0, c, at] * before + alpha[1, c, at] * y + beta[0, c, k]
                y = alpha[2, c, at] * before + alpha[3, c, at] * y + beta[1, c, k]
                out[1, c, k] = y
            out[0, c, k] = x
    return out
