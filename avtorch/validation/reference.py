"""References that SGLD is compared with: quadrature, the draws of a quadrature, and NUTS by Pyro."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.density import Density, SelectableDensity, constrained
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature, integrate
from avtorch.validation.windows import Windows

#: Nodes an axis, and for the windows where these are too few. A weak window's posterior is a funnel: the shorter the
#: lag, the narrower the range of the gain, and a grid for the wide end is coarse at the narrow one.
NODES = (49, 97, 129)
#: Nodes an axis and half width [SD] of the grid that proposes; proposals per draw; windows at once.
CELLS, REACH, PROPOSALS, BLOCK = 25, 6.0, 8, 64


def reference(windows: Windows) -> Quadrature:
    """Quadrature of all windows; where fewer nodes sufficed, the marginals are interpolated to the last number of
    nodes."""
    # one by one: the grids of a batch are moved until the worst of its windows is covered, 117 649 nodes at a time
    return join([_one(windows.select(index)) for index in torch.arange(len(windows)).split(1)])


def _one(window: Windows) -> Quadrature:
    found = integrate(window.density, nodes=NODES[0])
    for nodes in NODES[1:]:
        if bool(found.converged.all()):
            break
        found = integrate(window.density, nodes=nodes)
    return resampled(found, NODES[-1])


def select(quadrature: Quadrature, index: Tensor) -> Quadrature:
    """The windows named by ``index``."""
    return _mapped(quadrature, lambda _, value: value[index])


def join(parts: list[Quadrature]) -> Quadrature:
    """The windows of several quadratures as one."""
    return _mapped(parts[0], lambda name, _: torch.cat([getattr(part, name) for part in parts]))


def _mapped(quadrature: Quadrature, change: Callable[[str, Tensor], Tensor]) -> Quadrature:
    """The same with every tensor changed, given its name."""
    names = [f.name for f in fields(Quadrature) if f.name != "names"]
    return replace(quadrature, **{name: change(name, getattr(quadrature, name)) for name in names})


def resampled(quadrature: Quadrature, nodes: int) -> Quadrature:
    """Marginals at ``nodes`` nodes over the same range, by the band-limited interpolant that its `cdf` integrates."""
    old = quadrature.nodes
    count = old.shape[-1]
    share = torch.linspace(0, 1, nodes, dtype=old.dtype)
    offset = (count - 1) * share[:, None] - torch.arange(count, dtype=old.dtype)
    # in the tails the interpolant oscillates at the level of round-off
    mass = (quadrature.mass @ torch.sinc(offset).T).clamp_min(0)
    places = torch.lerp(old[..., :1], old[..., -1:], share)
    return replace(quadrature, nodes=places, mass=mass / mass.sum(-1, keepdim=True))


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

    `density`, `quadrature`: of the same windows; the quadrature's moments place the grid. `mode`: of the density, if
    known; its correlations tilt the grid.
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
    axis = torch.linspace(-REACH, REACH, CELLS, dtype=center.dtype)
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


@dataclass(frozen=True)
class NutsSettings:
    """Chains, draws a chain and steps of adaptation of the NUTS reference.

    Raises `InputError` for fewer than 1 chain, 16 draws or 1 step of adaptation.

    Example:
        >>> from avtorch.validation import NutsSettings
        >>> quick = NutsSettings(chains=1, draws=200, warmup=100)  # for `validate`
        >>> quick.chains * quick.draws
        200
    """

    chains: int = 2
    draws: int = 1000
    warmup: int = 500

    def __post_init__(self) -> None:
        for name, least in (("chains", 1), ("draws", 16), ("warmup", 1)):
            if getattr(self, name) < least:
                raise InputError(f"{name}: found {getattr(self, name)}, needs {least} or more")


#: NUTS where a step costs milliseconds, and where it runs a filter over the rows (minutes per window even with fewer
#: draws).
NUTS_WINDOWS, LATENT_NUTS_WINDOWS = 3, 1
LATENT_NUTS = NutsSettings(chains=1, draws=300, warmup=200)


def walk_nuts(
    windows: Windows, index: Tensor, settings: NutsSettings, *, seed: int, done: Callable[[], None]
) -> Posterior:
    """NUTS on the windows named by ``index``, one after another; ``done`` is called after each."""
    from avtorch.inference.nuts import nuts

    found = []
    for i in index:
        one = windows.select(i[None])
        found.append(
            nuts(
                one.density,  # pyright: ignore[reportArgumentType]
                window=0,
                chains=settings.chains,
                draws=settings.draws,
                warmup=settings.warmup,
                seed=(seed + int(i)) % 2**63,
            )
        )
        done()
    return join_draws(found)


def join_draws(parts: list[Posterior]) -> Posterior:
    """Posteriors of different windows as one."""
    draws, converged = torch.cat([p.draws for p in parts], 2), torch.cat([p.converged for p in parts])
    why = [reason for p in parts for reason in (p.why or ("",) * len(p.converged))]
    return Posterior(parts[0].names, draws, converged, tuple(why))
