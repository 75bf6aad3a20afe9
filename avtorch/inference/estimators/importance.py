"""Importance sampling in place of SGLD's chains, window by window: for the latent form, whose gradients are dear."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.inference.belief import Summary
from avtorch.inference.density import Density, SelectableDensity
from avtorch.inference.importance import ImportanceSettings, WeightedDraws, weighted_draws
from avtorch.inference.sequential import SequentialInference


class ImportanceSampling(SequentialInference):
    """The same windows, densities and priors as SGLD's loop; each posterior by weighted draws (`weighted_draws`).

    A window whose weights are not reliable is sampled by SGLD, with ``settings``.

    Takes the arguments of :class:`SequentialInference`.

    Example:
        >>> import torch
        >>> from avtorch.inference import JerkDensity
        >>> from avtorch.inference.estimators import ImportanceSampling
        >>> from avtorch.validation import synthetic_windows
        >>> vehicle, window = ImportanceSampling(), synthetic_windows(1, seed=1).density
        >>> belief = vehicle.update(lambda index, prior: JerkDensity(window.statistics, prior), torch.tensor([True]))
        >>> belief.converged.item(), round(belief.stat("K_L")["mean"], 2)
        (True, 0.54)
    """

    def _solve(self, density: Density) -> tuple[Summary, Tensor, Tensor, Tensor]:
        settings = ImportanceSettings()
        draws = weighted_draws(density, settings, generator=self.generator)
        summary, moments = _summary(draws, len(self.belief.draws), self.generator), draws.moments()
        converged = draws.converged(settings)
        again = (~converged).nonzero().squeeze(-1)
        if not len(again) or (len(again) < density.windows and not isinstance(density, SelectableDensity)):
            return summary, *moments, converged
        whole = len(again) == density.windows
        part = density if whole or not isinstance(density, SelectableDensity) else density.select(again)
        chains, *log_moments, settled = super()._solve(part)
        table = [_put(one, dim, again, other) for one, dim, other in zip(summary, (0, 0, 0, 0, 1), chains, strict=True)]
        mean_z, cov_z = (_put(one, 0, again, other) for one, other in zip(moments, log_moments, strict=True))
        return Summary(*table), mean_z, cov_z, converged.index_put((again,), settled)


def _put(all_: Tensor, dim: int, index: Tensor, some: Tensor) -> Tensor:
    return all_.index_copy(dim, index, some)


def _summary(draws: WeightedDraws, kept: int, generator: torch.Generator) -> Summary:
    value = draws.z.exp()
    weight = draws.weight[..., None]
    mean = (weight * value).sum(0)
    sd = (weight * (value - mean).square()).sum(0).sqrt()
    low, high = draws.quantile(0.05).exp(), draws.quantile(0.95).exp()
    return Summary(mean, sd, low, high, draws.equal(kept, generator).exp())
