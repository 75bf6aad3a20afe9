"""Ranks of truths among posterior draws: are they uniform, and do intervals cover the truth?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from avtorch.validation.uniformity import bonferroni, chi2_p_value, dispersion_p_value, ecdf_band, ecdf_p_value

LEVELS = (0.5, 0.9, 0.95)
"""Interval levels whose coverage is computed."""


class SampledDensity(Protocol):
    """The interface of a posterior for ranks; :class:`JerkDensity` has it."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def log_likelihood(self, z: Tensor) -> Tensor: ...

    def log_prob(self, z: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class RankCalibration:
    """Ranks of truths among posterior draws, one row a replication.

    Attributes:
        names: the quantities: the parameters, then ``log_likelihood`` and ``log_posterior``.
        ranks: how many of ``draws`` nearly independent draws lie below the truth, ``(replication, quantity)``, in
            ``0..draws``; uniform if the posterior is right.
        draws: number of draws that a rank counts.
        below: posterior probability below the truth, from all the draws there are, ``(replication, quantity)``.
        dropped: replications left out because their chains did not settle.
    """

    names: tuple[str, ...]
    ranks: Tensor
    draws: int
    below: Tensor
    dropped: int = 0

    @classmethod
    def of(
        cls,
        density: SampledDensity,
        truth: Tensor,
        posterior: Tensor,
        usable: Tensor | None = None,
        *,
        draws: int = 99,
        inflate: float = 1.0,
    ) -> RankCalibration:
        """Rank truths, one a window.

        Args:
            density: the posteriors; its log likelihood and log density are quantities, too.
            truth: in ``z``, ``(window, parameter)``.
            posterior: draws of positive parameters in their own units, ``(draw, window, parameter)``.
            usable: ``(window,)`` bool; windows to leave out. All are usable by default.
            draws, inflate: as in :func:`sbc`.
        """
        posterior = posterior if inflate == 1 else inflated(posterior, inflate)
        usable = torch.ones(len(truth), dtype=torch.bool) if usable is None else usable
        z = torch.cat([truth.unsqueeze(0), posterior.log()])
        with torch.no_grad():
            scores = torch.stack([density.log_likelihood(z), density.log_prob(z)], -1)
        true, drawn = torch.cat([z, scores], -1)[:, usable].split([1, len(posterior)])
        # evenly over chains laid end to end: neighbours lie many steps or a chain apart
        few = drawn[torch.linspace(0, len(drawn) - 1, draws, dtype=torch.float64).round().long()]
        names = (*density.names, "log_likelihood", "log_posterior")
        below = (drawn < true).double().mean(0)
        return cls(names, (few < true).sum(0), draws, below, int((~usable).sum()))

    @property
    def replications(self) -> int:
        return len(self.ranks)

    def select(self, index: Tensor) -> RankCalibration:
        """The replications named by ``index``."""
        return RankCalibration(self.names, self.ranks[index], self.draws, self.below[index], self.dropped)

    def counts(self, bins: int = 20) -> Tensor:
        """Histogram of the ranks, ``(quantity, bin)``."""
        width = (self.draws + 1) / bins
        return torch.stack([torch.bincount((r / width).long(), minlength=bins) for r in self.ranks.T])

    @property
    def ecdf(self) -> Tensor:
        """Share of the ranks at or below ``0..draws``, ``(quantity, draws + 1)``; about ``(r+1)/(draws+1)``."""
        return self.counts(self.draws + 1).cumsum(-1).double() / self.replications

    def ecdf_band(self, level: float = 0.95) -> tuple[Tensor, Tensor]:
        """Simultaneous band of :attr:`ecdf` under uniform ranks, lower and upper, each ``(draws + 1,)``."""
        return ecdf_band(self.replications, self.draws, level=level)

    @property
    def p_values(self) -> dict[str, Tensor]:
        """p-values ``(quantity,)`` of uniform ranks by ``"chi2"`` (20 bins), ``"ecdf"`` and ``"dispersion"``."""
        tests = {"chi2": chi2_p_value, "ecdf": ecdf_p_value, "dispersion": dispersion_p_value}
        return {name: test(self.ranks, self.draws) for name, test in tests.items()}

    @property
    def p_value(self) -> float:
        """One p-value for all: the least of :attr:`p_values` times their number (Bonferroni)."""
        return bonferroni(torch.stack(list(self.p_values.values())))

    @property
    def coverage(self) -> dict[float, Tensor]:
        """Share of replications whose truth lies in the central interval of each of :data:`LEVELS`, ``(quantity,)``."""
        return {level: self.covered(level).double().mean(0) for level in LEVELS}

    def covered(self, level: float) -> Tensor:
        """Whether the central interval holds the truth, ``(replication, quantity)`` bool."""
        return (self.below - 0.5).abs() <= 0.5 * level

    def coverage_error(self, level: float) -> float:
        """Binomial standard error of :attr:`coverage` if the level holds."""
        return (level * (1 - level) / self.replications) ** 0.5


def inflated(posterior: Tensor, factor: float) -> Tensor:
    """Draws ``(draw, window, parameter)`` of positive parameters, stretched about their mean in the logarithm."""
    z = posterior.log()
    return (z.mean(0) + factor * (z - z.mean(0))).exp()
