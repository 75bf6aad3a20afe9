"""Distance of draws from a reference, window by window, and the distance that chance alone would cause.

Every measure is per window and parameter, in the parameter's own units or in SDs of the reference. Each comes with the
value expected from Monte Carlo error alone, so that a difference can be distinguished from noise.

R-hat and effective sample sizes are ArviZ's (extra ``validate``). Many short chains are joined into a few superchains
first: its autocorrelations are those of single chains, and over a chain of twenty draws they are biased. At an
autocorrelation of 0.3 it counts 3 660 effective draws in 256 chains of 20 draws where there are 2 850; over eight
superchains 2 875. Chains that stand still in different places are still detected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from scipy.stats import binomtest, chi2
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.arviz_export import arviz
from avtorch.inference.posterior import Posterior
from avtorch.inference.quadrature import Quadrature

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


#: The tolerance asked for: difference of means in SDs of the reference, and of the ratio of SDs from one.
MEAN_TOLERANCE, SD_TOLERANCE = 0.1, 0.05
#: Points of the grid that the distance of two distribution functions is integrated over; 0.03 SDs apart.
GRID = 513
#: Share of the windows that must meet the tolerance.
REQUIRED_SHARE = 0.95
#: Below this p-value of NUTS against quadrature the references contradict each other.
REFERENCES_P = 0.001
#: Standard errors by which the tolerance is widened where the reference, NUTS, has an error of its own.
SLACK = 2.0


@dataclass(frozen=True)
class Agreement:
    """Draws against a reference. All shapes are ``(window, parameter)``.

    Attributes:
        names: parameter names, in the order of the last dimension.
        mean_difference: mean less the reference's, in SDs of the reference.
        mean_error: its Monte Carlo standard error.
        sd_ratio: SD over the reference's.
        sd_error: its Monte Carlo standard error.
        w1: Wasserstein-1 distance of the marginals, in SDs of the reference.
        w1_expected: the expectation of `w1` for independent exact draws of the same effective number.
        z_mean, z_sd: differences of mean and of SD over their Monte Carlo standard errors.
        rhat: rank-normalised split R-hat, over superchains (see `avtorch.validation.agreement`).
        ess_bulk, ess_tail: effective sample sizes for the bulk and for the 5 % and 95 % quantiles.
    """

    names: tuple[str, ...]
    mean_difference: Tensor
    mean_error: Tensor
    sd_ratio: Tensor
    sd_error: Tensor
    w1: Tensor
    w1_expected: Tensor
    z_mean: Tensor
    z_sd: Tensor
    rhat: Tensor
    ess_bulk: Tensor
    ess_tail: Tensor

    def within(self, *, slack: float = 0.0) -> Tensor:
        """Windows that meet the tolerance in every parameter, ``(window,)`` bool.

        ``slack`` widens it by so many Monte Carlo standard errors, for a reference that has an error of its own.
        """
        mean = self.mean_difference.abs() <= MEAN_TOLERANCE + slack * self.mean_error
        sd = (self.sd_ratio - 1).abs() <= SD_TOLERANCE + slack * self.sd_error
        return (mean & sd).all(-1)

    def chance_within(self, *, slack: float = 0.0) -> Tensor:
        """Probability that exact draws of the same effective number meet the tolerance, ``(window,)``.

        Normal errors, taken as independent between mean and SD and between parameters, which errs on the low side.
        """

        def inside(tolerance: float, error: Tensor) -> Tensor:
            return torch.special.erf((tolerance / error + slack) / math.sqrt(2))

        return (inside(MEAN_TOLERANCE, self.mean_error) * inside(SD_TOLERANCE, self.sd_error)).prod(-1)


def agreement(posterior: Posterior, quadrature: Quadrature) -> Agreement:
    """Draws against quadrature over the same windows.

    Raises `InputError` if parameters or windows differ, or ArviZ is missing.

    Example:
        >>> import torch
        >>> from avtorch.inference import integrate, sample
        >>> from avtorch.validation import agreement, synthetic_windows
        >>> density = synthetic_windows(1, seed=1).density
        >>> posterior = sample(density, generator=torch.Generator().manual_seed(0))
        >>> found = agreement(posterior, integrate(density, nodes=25))
        >>> bool((found.mean_difference.abs() < 0.1).all()), bool(((found.sd_ratio - 1).abs() < 0.1).all())
        (True, True)
    """
    _same(posterior, quadrature.names, len(quadrature.mean))
    found = sampling_diagnostics(posterior)
    nodes = quadrature.nodes
    share = torch.linspace(0, 1, GRID, dtype=nodes.dtype)
    grid = torch.lerp(nodes[..., :1], nodes[..., -1:], share).exp()  # (window, parameter, grid)
    below = quadrature.cdf(grid.movedim(-1, 0)).movedim(0, -1).clamp(0, 1)
    ordered = posterior.flat.movedim(0, -1).sort(-1).values.contiguous()
    empirical = torch.searchsorted(ordered, grid.contiguous(), right=True) / ordered.shape[-1]
    # beyond the grid the reference has no mass: every draw there counts with its distance
    outside = (ordered - grid[..., -1:]).clamp_min(0).mean(-1) + (grid[..., :1] - ordered).clamp_min(0).mean(-1)
    w1 = torch.trapezoid((empirical - below).abs(), grid) + outside
    spread = torch.trapezoid((below * (1 - below)).sqrt(), grid)
    none = torch.zeros_like(quadrature.mean)
    endless = torch.full_like(none, torch.inf)
    exact = replace(found, mean=quadrature.mean, sd=quadrature.sd, mean_error=none, sd_error=none, ess_mean=endless)
    return _agreement(found, exact, w1, spread)


def between(posterior: Posterior, other: Posterior) -> Agreement:
    """Draws against other draws of the same windows, ``other`` being the reference; both have Monte Carlo errors.

    Raises `InputError` if parameters or windows differ, or ArviZ is missing.

    Example:
        >>> import torch
        >>> from avtorch.inference import sample
        >>> from avtorch.validation import between, synthetic_windows
        >>> density = synthetic_windows(1, seed=1).density
        >>> posterior, other = (sample(density, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
        >>> bool((between(posterior, other).mean_difference.abs() < 0.2).all())
        True
    """
    _same(posterior, other.names, other.draws.shape[2])
    found, reference = sampling_diagnostics(posterior), sampling_diagnostics(other)
    first, second = posterior.flat, other.flat
    value, order = torch.cat([first, second]).sort(0)
    mine = (order < len(first)).to(value)
    apart = (mine.cumsum(0) / len(first) - (1 - mine).cumsum(0) / len(second)).abs()
    w1 = (apart[:-1] * value.diff(dim=0)).sum(0)
    below = torch.arange(1, len(second), dtype=value.dtype)[:, None, None] / len(second)
    spread = ((below * (1 - below)).sqrt() * second.sort(0).values.diff(dim=0)).sum(0)
    return _agreement(found, reference, w1, spread)


def _agreement(found: Diagnostics, reference: Diagnostics, w1: Tensor, spread: Tensor) -> Agreement:
    """``spread``: the integral of ``sqrt(F (1 - F))`` of the reference's distribution function, as ``w1`` in its own
    units."""
    sd = reference.sd
    mean_difference, ratio = (found.mean - reference.mean) / sd, found.sd / sd
    mean_error = torch.hypot(found.mean_error / sd, reference.mean_error / sd)
    sd_error = torch.hypot(found.sd_error / sd, ratio * (reference.sd_error / sd))
    # E|F_n - F| of n independent draws is sqrt(2/pi F (1 - F) / n)
    expected = math.sqrt(2 / math.pi) * spread * (1 / found.ess_mean + 1 / reference.ess_mean).sqrt() / sd
    return Agreement(
        names=found.names,
        mean_difference=mean_difference,
        mean_error=mean_error,
        sd_ratio=ratio,
        sd_error=sd_error,
        w1=w1 / sd,
        w1_expected=expected,
        z_mean=mean_difference / mean_error,
        z_sd=(ratio - 1) / sd_error,
        rhat=found.rhat,
        ess_bulk=found.ess_bulk,
        ess_tail=found.ess_tail,
    )


def _same(posterior: Posterior, names: tuple[str, ...], windows: int) -> None:
    if posterior.names != tuple(names):
        raise InputError(f"reference: has the parameters {tuple(names)}, not {posterior.names}")
    if posterior.draws.shape[2] != windows:
        raise InputError(f"reference: has {windows} windows, not {posterior.draws.shape[2]}")


@dataclass(frozen=True)
class AgreementVerdict:
    """Whether they agree, and how certain that is.

    Attributes:
        agree: whether the share is at least `REQUIRED_SHARE` (0.95) and NUTS does not contradict quadrature.
        share: of the windows compared that meet the tolerance in every parameter.
        low, high: exact binomial 95 % interval of the share.
        share_if_exact: the share that exact draws of the same effective number would be expected to reach.
        nuts_p: p-value of the chi^2 test of NUTS's means against quadrature, or None where there is no quadrature.
        why: a plain sentence.
    """

    agree: bool
    share: float
    low: float
    high: float
    share_if_exact: float
    nuts_p: float | None
    why: str


def chi2_of_means(agreement: Agreement) -> float:
    """p-value of the z-scores of the means: chi^2 over the windows for each parameter, then Bonferroni.

    Parameters of one window are correlated, windows are not: so each parameter has a test of its own, and the smallest
    p-value counts, times their number.
    """
    z = agreement.z_mean.numpy()
    smallest = float(chi2.sf((z**2).sum(0), len(z)).min())
    return min(1.0, z.shape[1] * smallest)


def agreement_verdict(
    agreement: Agreement,
    converged: Tensor,
    *,
    reference: str = "quadrature",
    numbers: Sequence[int] | None = None,
    nuts: Agreement | None = None,
) -> AgreementVerdict:
    """The verdict over the windows of ``agreement``.

    Args:
        converged: ``(window,)`` bool; a window whose chains or whose reference did not settle does not pass.
        reference: "quadrature", or "nuts", whose own error widens the tolerance by `SLACK` standard errors.
        numbers: numbers of the windows for the text; 0, 1, ... by default.
        nuts: NUTS against quadrature, if both were run.
    """
    slack = 0.0 if reference == "quadrature" else SLACK
    passed = agreement.within(slack=slack) & converged
    count, good = len(passed), int(passed.sum())
    interval = binomtest(good, count).proportion_ci(0.95, method="exact")
    exact = float(agreement.chance_within(slack=slack).nan_to_num(nan=0.0).mean())
    p = None if nuts is None else chi2_of_means(nuts)
    contradicted = p is not None and p < REFERENCES_P
    enough = good >= REQUIRED_SHARE * count
    parts = [_counted(good, count, interval.low, interval.high, reference, slack)]
    if not enough:
        parts.append(f"{_percent(REQUIRED_SHARE)} are needed")
    unconverged = int((~converged).sum())
    if unconverged:
        parts.append(f"the chains or the reference of {unconverged} did not converge")
    if good < count:
        parts.append(_furthest(agreement, converged, range(count) if numbers is None else numbers))
    if interval.low < REQUIRED_SHARE <= interval.high:
        parts.append("more windows could still change the verdict")
    if exact < REQUIRED_SHARE:
        parts.append(f"exact draws of the same effective number would only reach {_percent(exact)}: take more draws")
    else:
        parts.append(f"exact draws of the same effective number would reach {_percent(exact)}")
    if p is not None and nuts is not None:
        finding = "contradicts" if contradicted else "agrees with"
        parts.append(f"NUTS {finding} quadrature on {len(nuts.z_mean)} of them (chi² p {p:.2g})")
    return AgreementVerdict(
        agree=enough and not contradicted,
        share=good / count,
        low=float(interval.low),
        high=float(interval.high),
        share_if_exact=exact,
        nuts_p=p,
        why="; ".join(parts) + ".",
    )


def _counted(good: int, count: int, low: float, high: float, reference: str, slack: float) -> str:
    widened = f", widened by {slack:g} standard errors of their difference," if slack else ""
    return (
        f"{good} of {count} windows ({_percent(good / count)}, 95 % interval {_percent(low)} to {_percent(high)}) have "
        f"every mean within {MEAN_TOLERANCE:g} SD and every SD within {SD_TOLERANCE * 100:g} %{widened} of {reference}"
    )


def _percent(share: float) -> str:
    return f"{round(100 * share, 1):g} %"


def _furthest(agreement: Agreement, converged: Tensor, numbers: Sequence[int]) -> str:
    """The settled window that is furthest from the reference, in units of the tolerance."""
    off = torch.stack(
        [agreement.mean_difference.abs() / MEAN_TOLERANCE, (agreement.sd_ratio - 1).abs() / SD_TOLERANCE], -1
    )
    off = torch.where(converged[:, None, None], off, 0.0).nan_to_num(nan=0.0)
    window, parameter, kind = torch.unravel_index(off.argmax(), off.shape)
    name = agreement.names[int(parameter)]
    if int(kind) == 0:
        finding = f"mean of {name} {float(agreement.mean_difference[window, parameter]):+.2f} SD"
    else:
        finding = f"SD of {name} {float(agreement.sd_ratio[window, parameter]):.3f} times the reference's"
    return f"furthest: window {numbers[int(window)]}, {finding}"
