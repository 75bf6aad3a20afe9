"""SGLD's loop with another posterior of each window: the mode with its curvature, or weighted draws."""

from __future__ import annotations

from functools import partial

import torch

from avtorch.inference.belief import Summary
from avtorch.inference.density import Density, SelectableDensity
from avtorch.inference.importance import ImportanceSettings, WeightedDraws, weighted_draws
from avtorch.inference.map import Mode, find_mode
from avtorch.inference.sequential import SequentialInference, Solved

WIDEST = 3.0
"""SD of a logarithm, twice the widest prior's, above which the curvature at the mode does not describe the
posterior."""


class MaximumAPosteriori(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior is replaced by a normal in the log space.

    Its mean is the mode and its covariance the inverse curvature there (Laplace), so that the belief's median is the
    mode and its draws are log-normal. Exact where the log posterior is quadratic; the long tail of a skewed one is
    lost.

    Takes the arguments of :class:`SequentialInference`; ``settings`` do not apply.
    """

    def _solve(self, density: Density) -> Solved:
        mode = find_mode(density)
        converged = mode.converged & (mode.covariance.diagonal(dim1=-2, dim2=-1).amax(-1) < WIDEST**2)
        # the others are not used; any finite covariance will do
        covariance = torch.where(
            converged[:, None, None],
            mode.covariance,
            torch.eye(mode.z.shape[-1], dtype=mode.z.dtype, device=mode.z.device),
        )
        summary = Summary.log_normal(mode.z, covariance, self.kept, self.generator)
        return Solved(summary, mode.z, covariance, converged)


AGAINST_SGLD = (
    "Importance sampling in place of SGLD, whose gradients are dear here: on 24 windows its means lay within 0.08 SD "
    "of a long reference in 95 %, SGLD's within 0.18."
)
"""The estimator's error beside SGLD's, for answers; `benchmarks/estimators.md` has the table."""

FIRST = ImportanceSettings()
WIDER = ImportanceSettings(draws=512, rounds=8, degrees=3, width=1.3)
"""Tried where the first draws' weights are not reliable: heavier and wider proposals, up to twice as many draws."""
MANY = ImportanceSettings(draws=4096, rounds=8, enough=1000.0, degrees=3, width=1.3)
"""Tried where those are not reliable either: up to eight times as many, for a fifth of the time of SGLD's chains,
and far less than that where rows are uneven."""


class ImportanceSampling(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior by weighted draws (`weighted_draws`).

    A window whose weights are not reliable is drawn again, from wider proposals and then from many. Where they are not
    reliable either, it is sampled by SGLD, with ``settings``.

    Takes the arguments of :class:`SequentialInference`.
    """

    def _solve(self, density: Density) -> Solved:
        # proposals need no better mode: it is within a hundredth of an SD
        mode = find_mode(density, from_values=True, tolerance=5e-5)
        found = self._drawn(density, mode, FIRST)
        for attempt in (partial(self._drawn, settings=WIDER), partial(self._drawn, settings=MANY), self._chains):
            again = (~found.converged).nonzero().squeeze(-1)
            if not len(again):
                break
            if len(again) == density.windows:
                found = attempt(density, mode)
            elif isinstance(density, SelectableDensity):
                found = found.put(again, attempt(density.select(again), mode.select(again)))
        return found

    def _drawn(self, density: Density, mode: Mode, settings: ImportanceSettings) -> Solved:
        draws = weighted_draws(density, settings, generator=self.generator, mode=mode)
        summary = _summary(draws, self.kept, self.generator)
        return Solved(summary, *draws.moments(), mode.converged & draws.converged(settings))

    def _chains(self, density: Density, mode: Mode) -> Solved:
        return super()._solve(density)


def _summary(draws: WeightedDraws, kept: int, generator: torch.Generator) -> Summary:
    value, weight = draws.z.exp(), draws.weight[..., None]
    mean = (weight * value).sum(0)
    sd = (weight * (value - mean).square()).sum(0).sqrt()
    low, high = draws.quantile(0.05).exp(), draws.quantile(0.95).exp()
    return Summary(mean, sd, low, high, draws.equal(kept, generator).exp())
