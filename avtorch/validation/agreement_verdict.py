"""The verdict on many windows: do SGLD's posteriors agree with the reference, and how certain is the verdict?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.stats import binomtest, chi2
from torch import Tensor

from avtorch.validation.agreement import MEAN_TOLERANCE, SD_TOLERANCE, Agreement

#: Share of the windows that must meet the tolerance.
REQUIRED_SHARE = 0.95
#: Below this p-value of NUTS against quadrature the references contradict each other.
REFERENCES_P = 0.001
#: Standard errors by which the tolerance is widened where the reference, NUTS, has an error of its own.
SLACK = 2.0


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

    Example:
        >>> from avtorch.validation import AgreementVerdict
        >>> why = "98 of 100 windows agree"
        >>> verdict = AgreementVerdict(True, share=0.98, low=0.93, high=1.0, share_if_exact=0.97, nuts_p=0.4, why=why)
        >>> verdict.agree, verdict.low <= verdict.share <= verdict.high
        (True, True)
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
