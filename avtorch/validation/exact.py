"""A quadrature as draws: independent draws of the joint posterior, for pair plots and for tools that take draws."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.inference.density import Density, SelectableDensity, constrained
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature

#: Nodes an axis and half width [SD] of the grid that proposes; proposals per draw; windows at once.
NODES, REACH, PROPOSALS, BLOCK = 25, 6.0, 8, 64


def exact_draws(
    density: Density,
    quadrature: Quadrature,
    *,
    mode: Mode | None = None,
    chains: int = 4,
    draws: int = 500,
    generator: torch.Generator | None = None,
) -> Posterior:
    """Draws ``(chain, draw, window, parameter)`` of the density that a quadrature integrated.

    Cells of a coarse grid are drawn by their weight and points in them uniformly; importance resampling then corrects
    them to the density itself. There is no Markov chain: the chains are only a layout.

    Args:
        density, quadrature: of the same windows; the quadrature's moments place the grid.
        mode: of the density, if known; its correlations tilt the grid.
    """
    mode = find_mode(density) if mode is None else mode
    found = []
    for first in range(0, density.windows, BLOCK):
        index = torch.arange(first, min(first + BLOCK, density.windows))
        whole = len(index) == density.windows or not isinstance(density, SelectableDensity)
        part = density if whole else density.select(index)  # pyright: ignore[reportAttributeAccessIssue]
        rows = slice(None) if whole else index
        found.append(_draw(part, *_grid(quadrature, mode, rows), chains * draws, generator))
        if whole:
            break
    z = torch.cat(found, 1)
    value = constrained(density, z).unflatten(0, (chains, draws))
    return Posterior(quadrature.names, value, quadrature.converged)


def _grid(quadrature: Quadrature, mode: Mode, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
    """Centre ``(window, d)`` and triangular scale ``(window, d, d)`` in SDs of ``z``."""
    nodes, mass = quadrature.nodes[rows], quadrature.mass[rows]
    center = (mass * nodes).sum(-1)
    sd = (mass * (nodes - center.unsqueeze(-1)).square()).sum(-1).sqrt()
    covariance = mode.covariance[rows]
    laplace = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    return center, torch.linalg.cholesky(covariance) * (sd / laplace).unsqueeze(-1)


def _draw(density: Density, center: Tensor, lower: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """``count`` draws of ``z``, ``(draw, window, d)``."""
    windows, d = center.shape
    axis = torch.linspace(-REACH, REACH, NODES, dtype=center.dtype)
    cells = torch.cartesian_prod(*[axis] * d).reshape(-1, d)

    def log_prob(x: Tensor) -> tuple[Tensor, Tensor]:
        z = center + torch.einsum("wij,nwj->nwi", lower, x)
        with torch.no_grad():
            return z, density.log_prob(z).nan_to_num(nan=-torch.inf)

    _, height = log_prob(cells[:, None].expand(-1, windows, -1))
    # proposals systematically over the cells, which loses nothing; draws from them independently
    proposals = PROPOSALS * count
    offset = torch.rand(windows, 1, generator=generator, dtype=center.dtype)
    even = (torch.arange(proposals, dtype=center.dtype) + offset) / proposals
    cell = _pick((height - height.amax(0)).exp(), even)
    width = float(axis[1] - axis[0])
    inside = width * (torch.rand(*cell.shape, d, generator=generator, dtype=center.dtype) - 0.5)
    z, proposed = log_prob(cells[cell] + inside)
    log_weight = proposed - height.gather(0, cell)
    uniform = torch.rand(windows, count, generator=generator, dtype=center.dtype)
    kept = _pick((log_weight - log_weight.amax(0)).exp(), uniform)
    return z.take_along_dim(kept.unsqueeze(-1), 0)


def _pick(weight: Tensor, share: Tensor) -> Tensor:
    """Indices ``(count, window)`` into ``weight`` ``(item, window)`` at ``share`` ``(window, count)`` of its total."""
    cumulated = weight.cumsum(0).T.contiguous()
    return torch.searchsorted(cumulated, share * cumulated[:, -1:], right=True).clamp_max(len(weight) - 1).T
