"""Linear recursions over time, all rows at once.

    x[k] = alpha[k] x[k-1] + beta[k],    x[-1] = start

as a blocked scan: rows are cut into about sqrt(N) blocks that are stepped in parallel, each from zero; then the blocks'
ends are chained, and each block adds its inherited state. This takes 2 sqrt(N) small tensor operations instead of N,
without truncation and with products only, so nothing overflows where alpha is zero. The derivative of a linear
recursion is a linear recursion (backward in time for the gradient, forward for a tangent), hence derivatives of any
order.

`scan` takes a scalar state, `scan_pair` a state of two components with 2 x 2 matrices. In `torch.inference_mode`, where
no derivatives are needed, rows follow one another in compiled code, several times as fast: constant recursions in
SciPy's filter, others as a band matrix that is solved by substitution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.linalg import get_blas_funcs
from scipy.signal import lfilter
from torch import Tensor

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
    aligned = _aligned(1, [alpha], [beta], [start])
    if torch.is_inference_mode_enabled():
        return _compiled(1, aligned[1:])[0]
    return _Scan.apply(*aligned)[0]


def scan_pair(
    matrix: tuple[Tensor, Tensor, Tensor, Tensor], beta: tuple[Tensor, Tensor], start: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """The two components (..., time) of `x[k] = A[k] x[k-1] + beta[k]`, `A = [[m0, m1], [m2, m3]]`.

    Args: `matrix` four of (..., time) or (..., 1), `beta` two of (..., time), `start` two of (...). All broadcast.

    Example:
        >>> import torch
        >>> from avtorch.gap import scan_pair
        >>> turn = tuple(torch.tensor([x]) for x in (0.0, -1.0, 1.0, 0.0))  # by 90 degrees a row
        >>> none, start = torch.zeros(4), (torch.tensor(1.0), torch.tensor(0.0))
        >>> x, y = scan_pair(turn, (none, none), start)
        >>> (x + 0.0).tolist(), (y + 0.0).tolist()
        ([0.0, -1.0, 0.0, 1.0], [1.0, 0.0, -1.0, 0.0])
    """
    aligned = _aligned(2, list(matrix), list(beta), list(start))
    first, second = _compiled(2, aligned[1:]) if torch.is_inference_mode_enabled() else _Scan.apply(*aligned)
    return first, second


def _compiled(n: int, parts: Sequence[Tensor]) -> _Components:
    """The recursion without derivatives."""
    alpha, beta, start = _split(n, parts)
    first = _apply(n, [a[..., :1] for a in alpha], start, [b[..., :1] for b in beta])
    beta = [torch.cat([x, b[..., 1:]], -1) for x, b in zip(first, beta, strict=True)]
    if alpha[0].shape[-1] > 1:
        return _substituted(n, alpha, beta)
    if n == 1:
        return [_filtered([-alpha[0]], beta[0])]
    # each component by itself: the other one's inputs reach it a row later
    m0, m1, m2, m3 = alpha
    b0, b1 = beta
    inputs = [b0 + _later(m1 * b1 - m3 * b0), b1 + _later(m2 * b0 - m0 * b1)]
    return [_filtered([-(m0 + m3), m0 * m3 - m1 * m2], x) for x in inputs]


def _later(x: Tensor) -> Tensor:
    return torch.nn.functional.pad(x[..., :-1], (1, 0))


def _filtered(bottom: _Components, x: Tensor) -> Tensor:
    """`x` (..., time) through `1 / (1 + bottom[0] / z + ...)`, every column with its own filter."""
    below = torch.cat([torch.ones_like(bottom[0]), *bottom], -1).reshape(-1, len(bottom) + 1).numpy()
    rows = x.reshape(len(below), -1).numpy()
    out = np.stack([lfilter(_ONE, own, row) for own, row in zip(below, rows, strict=True)])
    return torch.from_numpy(out).reshape(x.shape)


def _substituted(n: int, alpha: _Components, beta: _Components) -> _Components:
    """Solution of the band matrix that all columns' rows form together; a column does not reach into the next."""
    shape = beta[0].shape
    below = np.zeros((beta[0].numel() // shape[-1], shape[-1], n, 2 * n))  # (column, time, component, further down)
    for i in range(n):
        for j in range(n):
            below[:, :-1, j, n + i - j] = -alpha[i * n + j].reshape(-1, shape[-1])[:, 1:]
    x = _SUBSTITUTE(2 * n - 1, below.reshape(-1, 2 * n).T, torch.stack(beta, -1).numpy().ravel(), lower=1, diag=1)
    return list(torch.from_numpy(x).reshape(*shape, n).unbind(-1))


_ONE = np.ones(1)
_SUBSTITUTE = get_blas_funcs(("tbsv",), dtype=np.float64)[0]


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

    generate_vmap_rule = True

    @staticmethod
    def forward(n: int, *parts: Tensor) -> tuple[Tensor, ...]:
        alpha, beta, start = _split(n, parts)
        return tuple(_blocked(n, alpha, beta, start))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        n, *parts = inputs
        ctx.n = n
        ctx.save_for_backward(*parts, *output)
        ctx.save_for_forward(*parts, *output)

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

    @staticmethod
    def jvp(ctx: Any, _: Any, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        n = ctx.n
        saved = ctx.saved_tensors
        (alpha, beta, start), x = _split(n, saved[:-n]), saved[-n:]
        t_alpha, t_beta, t_start = tangents[: n * n], tangents[n * n : n * n + n], tangents[n * n + n :]
        before = [torch.cat([s, xi[..., :-1]], -1) for s, xi in zip(start, x, strict=True)]
        drive = []
        for i in range(n):
            tangent = t_beta[i]
            total = torch.zeros_like(beta[i]) if tangent is None else tangent
            for j in range(n):
                change = t_alpha[i * n + j]
                total = total if change is None else total + change * before[j]
            drive.append(total)
        first = [torch.zeros_like(s) if t is None else t for s, t in zip(start, t_start, strict=True)]
        return tuple(_Scan.apply(n, *alpha, *drive, *first))


def _split(n: int, parts: Sequence[Tensor]) -> tuple[_Components, _Components, _Components]:
    return list(parts[: n * n]), list(parts[n * n : n * n + n]), list(parts[n * n + n : n * n + 2 * n])


def _blocked(n: int, alpha: _Components, beta: _Components, start: _Components) -> _Components:
    steps = beta[0].shape[-1]
    constant = alpha[0].shape[-1] == 1
    if steps <= 32:
        return _stepped(n, _unbound(alpha, steps), [b.unbind(-1) for b in beta], [s[..., 0] for s in start])
    length = math.isqrt(steps - 1) + 1
    blocks = -(-steps // length)
    inside = [_cut(b, blocks, length) for b in beta]  # `length` tensors of (..., block) each
    factor = [[a] * length for a in alpha] if constant else [_cut(a, blocks, length) for a in alpha]
    state, power = [b[0] for b in inside], [f[0] for f in factor]
    own, reach = [list(state)], [list(power)]
    for k in range(1, length):
        step = [f[k] for f in factor]
        state = _apply(n, step, state, [b[k] for b in inside])
        power = _product(n, step, power)
        own.append(state)
        reach.append(power)
    # state inherited by each block: the ends of the earlier ones, by a scan over blocks
    ends = [x.expand_as(state[0]) for x in state]
    whole = [p if constant else p.expand_as(state[0]) for p in power]
    joined = _blocked(n, whole, ends, start)
    inherited = [torch.cat([s, j[..., :-1]], -1) for s, j in zip(start, joined, strict=True)]
    out = []
    for i in range(n):
        x = torch.stack([row[i] for row in own], 0)
        for j in range(n):
            x = torch.addcmul(x, torch.stack([row[i * n + j] for row in reach], 0), inherited[j])
        out.append(x.movedim(0, -1).reshape(*x.shape[1:-1], blocks * length)[..., :steps])
    return out


def _cut(x: Tensor, blocks: int, length: int) -> tuple[Tensor, ...]:
    """(..., time) as `length` contiguous tensors (..., block): the rows at one position within their blocks."""
    short = blocks * length - x.shape[-1]
    if short:
        x = torch.cat([x, x.new_zeros(()).expand(*x.shape[:-1], short)], -1)
    return x.reshape(*x.shape[:-1], blocks, length).movedim(-1, 0).contiguous().unbind(0)


def _unbound(alpha: _Components, steps: int) -> list[tuple[Tensor, ...]]:
    return [(a[..., 0],) * steps if a.shape[-1] == 1 else a.unbind(-1) for a in alpha]


def _stepped(n: int, alpha: list[tuple[Tensor, ...]], beta: list[tuple[Tensor, ...]], x: _Components) -> _Components:
    rows = []
    for k in range(len(beta[0])):
        x = _apply(n, [a[k] for a in alpha], x, [b[k] for b in beta])
        rows.append(x)
    return [torch.stack([row[i] for row in rows], -1) for i in range(n)]


def _apply(n: int, alpha: _Components, x: _Components, beta: _Components) -> _Components:
    """`A x + b`."""
    out = []
    for i in range(n):
        total = beta[i]
        for j in range(n):
            total = torch.addcmul(total, alpha[i * n + j], x[j])
        out.append(total)
    return out


def _product(n: int, left: _Components, right: _Components) -> _Components:
    if n == 1:
        return [left[0] * right[0]]
    return [torch.addcmul(left[i * 2] * right[j], left[i * 2 + 1], right[2 + j]) for i in range(2) for j in range(2)]
