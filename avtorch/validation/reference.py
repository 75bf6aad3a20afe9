"""Quadrature over many windows: block by block, and on a finer grid where the usual one is too coarse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import torch
from torch import Tensor

from avtorch.inference.quadrature import Quadrature, integrate
from avtorch.validation.windows import Windows

#: Nodes an axis, and for the windows where these are too few. A weak window's posterior is a funnel: the shorter the
#: lag, the narrower the range of the gain, and a grid for the wide end is coarse at the narrow one.
NODES = (49, 97, 129)


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
