"""R-hat and effective sample sizes of draws, by ArviZ, and the Monte Carlo errors that follow from them.

Many short chains are joined into a few superchains first. ArviZ's autocorrelations are those of single chains, and over
a chain of twenty draws they are biased: at an autocorrelation of 0.3 it counts 3 660 effective draws in 256 chains of
20 draws where there are 2 850, and gives an R-hat of 1.04 where the chains are stationary and independent. Over eight
superchains the figures are 2 875 and 1.001: at lag ``t`` a share ``t/n`` of the pairs straddles two independent chains
of ``n`` draws, and that is the very factor by which ``t`` counts in the variance of their mean. Chains that stand still
in different places are still detected: their superchain is a sequence of plateaus, with an autocorrelation as long as a
chain.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from types import ModuleType

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.posterior import Posterior

#: Superchains that more chains than this are joined into.
SUPERCHAINS = 8


@dataclass(frozen=True)
class Diagnostics:
    """Moments of draws and their errors; shapes ``(window, parameter)``, in the parameters' units.

    ``mean_error`` and ``sd_error`` are Monte Carlo standard errors; ``ess_mean`` is the effective number of draws
    behind the mean, ``ess_bulk`` and ``ess_tail`` are rank-normalised and of the 5 % and 95 % quantiles.
    """

    names: tuple[str, ...]
    mean: Tensor
    sd: Tensor
    mean_error: Tensor
    sd_error: Tensor
    rhat: Tensor
    ess_mean: Tensor
    ess_bulk: Tensor
    ess_tail: Tensor


def arviz() -> ModuleType:
    """ArviZ, or an `InputError` with the command that installs it."""
    with warnings.catch_warnings():
        # ArviZ 0.23 announces its successor on import
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        try:
            import arviz
        except ImportError:
            raise InputError("arviz: not installed; validation needs pip install 'avtorch[validate]'") from None
    return arviz


def superchains(draws: Tensor, count: int = SUPERCHAINS) -> Tensor:
    """``(chain, draw, ...)`` with the chains joined into at most ``count``; chains left over are dropped.

    A single chain is cut into two, as R-hat compares.
    """
    chains, length = draws.shape[:2]
    if chains == 1:
        return draws[:, : length // 2 * 2].reshape(2, -1, *draws.shape[2:])
    if chains <= count:
        return draws
    return draws[: chains // count * count].reshape(count, -1, *draws.shape[2:])


def sampling_diagnostics(posterior: Posterior) -> Diagnostics:
    """Moments, R-hat and effective sample sizes of every window.

    Raises `InputError` if ArviZ is missing, or for fewer than four draws per (super)chain, the least that it can
    evaluate.
    """
    az = arviz()
    import xarray

    draws = superchains(posterior.draws)
    if draws.shape[1] < 4:
        raise InputError(f"posterior: {draws.shape[1]} draws a chain; R-hat and effective sample size need 4 or more")
    mean, sd = posterior.mean, posterior.sd
    whitened = (draws - mean) / sd
    dims = ("chain", "draw", "window", "parameter")
    data = xarray.Dataset({"first": (dims, whitened.numpy()), "second": (dims, whitened.square().numpy())})

    def values(measure: xarray.Dataset, name: str = "first") -> Tensor:
        return torch.from_numpy(measure[name].values)

    plain, ranked = az.ess(data, method="mean"), data[["first"]]
    ess_mean, ess_square = values(plain), values(plain, "second")
    # the delta method: var(SD)/SD^2 = (kurtosis - 1) / 4 over the draws effective for the square
    kurtosis = whitened.square().square().flatten(0, 1).mean(0)
    return Diagnostics(
        names=posterior.names,
        mean=mean,
        sd=sd,
        mean_error=sd / ess_mean.sqrt(),
        sd_error=0.5 * sd * ((kurtosis - 1).clamp_min(0) / ess_square).sqrt(),
        rhat=values(az.rhat(ranked)),
        ess_mean=ess_mean,
        ess_bulk=values(az.ess(ranked, method="bulk")),
        ess_tail=values(az.ess(ranked, method="tail")),
    )
