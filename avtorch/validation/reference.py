"""References that SGLD is compared with: quadrature, independent draws, and NUTS by Pyro."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.density import Density, constrained, selected
from avtorch.inference.importance import RELIABLE, ImportanceSettings, weighted_draws
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature, integrate
from avtorch.validation.windows import Windows

#: Nodes an axis, and for the windows where these are too few. A weak window's posterior is a funnel: the shorter the
#: lag, the narrower the range of the gain, and a grid for the wide end is coarse at the narrow one.
NODES = (49, 97, 129)
#: Proposals per exact draw; windows at once.
PROPOSALS, BLOCK = 8, 64


def reference(windows: Windows, *, done: Callable[[], None] = lambda: None) -> Quadrature:
    """Quadrature of all windows; where fewer nodes sufficed, the marginals are interpolated to the last number of
    nodes. ``done`` is called after each window."""
    found = []
    # one by one: the grids of a batch are moved until the worst of its windows is covered, 117 649 nodes at a time
    for index in torch.arange(len(windows)).split(1):
        density = windows.select(index).density
        for nodes in NODES:
            one = integrate(density, nodes=nodes)
            if bool(one.converged.all()):
                break
        found.append(resampled(one, NODES[-1]))
        done()
    return join(found)


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


def exact_draws(density: Density, *, chains: int = 4, draws: int = 500, generator: torch.Generator) -> Posterior:
    """Draws ``(chain, draw, window, parameter)`` of a density by importance resampling, PROPOSALS for each.

    There is no Markov chain: the chains are only a layout. ``converged`` is false where the weights are not reliable.
    """
    count = chains * draws
    settings = ImportanceSettings(draws=2 * count, rounds=PROPOSALS // 2, enough=PROPOSALS * count)
    found = []
    for index in torch.arange(density.windows).split(BLOCK):
        part = selected(density, index)
        weighted = weighted_draws(part, settings, generator=generator)
        kept = weighted.equal(count, generator)
        found.append((constrained(part, kept).unflatten(0, (chains, draws)), weighted.pareto_k < RELIABLE))
        if part is density:
            break
    values, good = zip(*found, strict=True)
    return Posterior(density.names, torch.cat(values, 2), torch.cat(good))


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
    draws, converged = torch.cat([p.draws for p in found], 2), torch.cat([p.converged for p in found])
    return Posterior(found[0].names, draws, converged)
