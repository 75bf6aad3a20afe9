"""Draws of a posterior and what is read off them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Posterior:
    """Draws of positive parameters for every window.

    Attributes:
        names: parameter names, in the order of the last dimension.
        draws: shape ``(chain, draw, window, parameter)``, in the parameters' own units.
        converged: ``(window,)`` bool; false where the chains left the posterior or disagree: draws not to be used.
        why: a reason for every window that did not converge, ``""`` for the others; empty if nobody said.
    """

    names: tuple[str, ...]
    draws: Tensor
    converged: Tensor
    why: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Tensor:
        """Draws of one parameter, shape ``(chain, draw, window)``."""
        return self.draws[..., self.names.index(name)]

    @property
    def flat(self) -> Tensor:
        """All draws, chains behind one another: ``(chain * draw, window, parameter)``."""
        return self.draws.flatten(0, 1)

    @property
    def mean(self) -> Tensor:
        """Posterior means, ``(window, parameter)``."""
        return self.flat.mean(0)

    @property
    def sd(self) -> Tensor:
        """Posterior standard deviations, ``(window, parameter)``."""
        return self.flat.std(0)

    def quantile(self, q: float) -> Tensor:
        """Posterior quantiles, ``(window, parameter)``."""
        return sorted_quantile(self.flat.sort(0).values, q)

    def log_moments(self) -> tuple[Tensor, Tensor]:
        """Mean ``(window, parameter)`` and covariance ``(window, parameter, parameter)`` of the log parameters."""
        z = self.flat.log()
        centred = z - z.mean(0)
        return z.mean(0), torch.einsum("nwi,nwj->wij", centred, centred) / (len(z) - 1)


def sorted_quantile(ordered: Tensor, q: float) -> Tensor:
    """Quantile along the first dimension of sorted draws, linear between order statistics."""
    position = q * (len(ordered) - 1)
    low = int(position)
    high = min(low + 1, len(ordered) - 1)
    return torch.lerp(ordered[low], ordered[high], position - low)


def nested_rhat(draws: Tensor, groups: int = 8) -> Tensor:
    """Split nested R-hat (Margossian et al. 2024) over ``(chain, draw, ...)``; returns the remaining shape.

    Many short chains are joined into ``groups`` superchains, cut into halves: chains of a few autocorrelation times
    each would look apart to the plain R-hat even at stationarity. A common drift shows between the halves, a chain that
    went elsewhere shows between the groups.
    """
    chains, count = draws.shape[:2]
    groups = max(1, min(groups, chains))
    members, half = chains // groups, count // 2
    used = draws[: groups * members, : 2 * half]
    used = used - used[0, 0]  # near zero the sums below keep their digits
    means, squares = [], []
    for part in used.split(half, 1):
        for table, x in ((means, part), (squares, part.square())):
            table.append(x.sum(1).unflatten(0, (groups, members)).sum(1) / (members * half))
    mean = torch.cat(means)  # (half x group, ...)
    within = (torch.cat(squares) - mean.square()).mean(0)
    between = mean.var(0)
    return (1 + between / within.clamp_min(torch.finfo(draws.dtype).tiny)).sqrt()
