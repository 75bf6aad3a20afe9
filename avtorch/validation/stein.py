r"""Kernel Stein discrepancy: the distance of draws from a density, from its score alone.

    KSD^2 = 1/n^2 sum_ij k_p(x_i, x_j),
    k_p(x, y) = s(x).s(y) k + s(x).grad_y k + s(y).grad_x k + tr grad_x grad_y k,     s = grad log p,

with the inverse multiquadric kernel `k(x, y) = (1 + |x - y|^2)^(-1/2)` in whitened coordinates, for which a vanishing
discrepancy implies convergence (Gorham and Mackey 2017). Under `p` the expectation of `k_p(x, .)` is zero, so for `n`
independent exact draws `E KSD^2 = E k_p(x, x) / n`: the value to compare with. The p-value is a wild bootstrap
(Chwialkowski, Strathmann and Gretton 2016).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.density import Density, score_of
from avtorch.inference.map import Mode, find_mode

#: Numbers of a kernel matrix at once, over windows.
BLOCK = 2**22


@dataclass(frozen=True)
class Stein:
    """Kernel Stein discrepancy of every window, ``(window,)`` each.

    Attributes:
        value: the discrepancy, in coordinates whitened at the mode.
        expected: root mean square of it for as many independent exact draws.
        p_value: share of the wild bootstrap at or above the value: small where the draws are not of the density.
        points: draws per window that were used.
    """

    value: Tensor
    expected: Tensor
    p_value: Tensor
    points: int


def stein_discrepancy(
    density: Density,
    z: Tensor,
    *,
    mode: Mode | None = None,
    points: int = 1000,
    flip: float = 0.5,
    bootstrap: int = 200,
    generator: torch.Generator | None = None,
) -> Stein:
    """Kernel Stein discrepancy of draws from a density's windows.

    Args:
        density: its ``score`` is used where it has one, autograd otherwise.
        z: draws ``(chain, draw, window, parameter)`` in the density's own unconstrained coordinates.
        mode: of the density, if known; the draws are whitened by its Laplace covariance.
        points: at most so many draws are used, evenly spaced along the chains (and over the chains, where there are
            more chains than points).
        flip: probability that the bootstrap's sign changes from one draw used to the next of its chain; 0.5 takes them
            as independent, less allows for their autocorrelation.

    Raises `InputError` for draws of another shape than the density's, fewer than two points, or ``flip`` not in (0,
    0.5].
    """
    if z.ndim != 4 or z.shape[2:] != (density.windows, len(density.names)):
        wanted = f"(chain, draw, {density.windows}, {len(density.names)})"
        raise InputError(f"z: found shape {tuple(z.shape)}, needs {wanted}")
    if points < 2 or z.shape[0] * z.shape[1] < 2:
        raise InputError(f"points: found {min(points, z.shape[0] * z.shape[1])}, needs 2 or more")
    if not 0 < flip <= 0.5:
        raise InputError(f"flip: found {flip}, needs a number in (0, 0.5]")
    mode = find_mode(density) if mode is None else mode
    thin = _thinned(z, points)
    sign = _signs(thin.shape[:2], bootstrap, flip, generator).to(z)
    flat = thin.flatten(0, 1)
    count, windows, _ = flat.shape
    # gradient in w of z = mode + scale w
    score = torch.einsum("wji,nwj->nwi", mode.scale, score_of(density, flat))
    w = torch.einsum("wij,nwj->nwi", torch.linalg.inv(mode.scale), flat - mode.z)
    value, expected, p_value = [], [], []
    step = max(1, BLOCK // count**2)
    for first in range(0, windows, step):
        part = slice(first, first + step)
        kernel = _stein_kernel(w[:, part].movedim(1, 0), score[:, part].movedim(1, 0))
        square = kernel.mean((-2, -1))
        wild = ((sign @ kernel) * sign).sum(-1) / count**2  # (window, bootstrap)
        value.append(square.clamp_min(0).sqrt())
        expected.append((kernel.diagonal(dim1=-2, dim2=-1).mean(-1) / count).sqrt())
        p_value.append((1 + (wild >= square[:, None]).sum(-1)) / (1 + bootstrap))
    return Stein(torch.cat(value), torch.cat(expected), torch.cat(p_value), count)


def _thinned(z: Tensor, points: int) -> Tensor:
    """At most ``points`` draws, ``(chain, draw, window, parameter)``: every k-th of a chain, every k-th chain."""
    chains, draws = z.shape[:2]
    per_chain = max(1, points // chains)
    z = z[:: -(-chains // points)]
    return z[:, draws % per_chain :: max(1, draws // per_chain)] if per_chain < draws else z


def _signs(shape: torch.Size, count: int, flip: float, generator: torch.Generator | None) -> Tensor:
    """Random signs ``(bootstrap, chain x draw)`` that change along a chain with probability ``flip``."""
    chains, draws = shape
    start = torch.rand(count, chains, 1, generator=generator) < 0.5
    turns = torch.rand(count, chains, draws - 1, generator=generator) < flip
    odd = torch.cat([start, turns], -1).cumsum(-1) % 2
    return (1 - 2 * odd).flatten(1)


def _stein_kernel(x: Tensor, score: Tensor) -> Tensor:
    """``k_p`` of all pairs, ``(window, n, n)``, from points and scores ``(window, n, d)``."""
    inner = x @ x.mT
    size = inner.diagonal(dim1=-2, dim2=-1)
    square = (size[..., :, None] + size[..., None, :] - 2 * inner).clamp_min(0)
    # (s(x) - s(y)) . (x - y), multiplied out so that no (n, n, d) is made
    cross = score @ x.mT
    own = cross.diagonal(dim1=-2, dim2=-1)
    along = own[..., :, None] + own[..., None, :] - cross - cross.mT
    base = (1 + square).reciprocal()
    k = base.sqrt()
    return k * ((score @ score.mT) + base * (along + x.shape[-1] - 3 * square * base))
