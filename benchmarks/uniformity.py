"""Are ranks uniform? Three tests of one hypothesis, and the simultaneous band of the ECDF, all without simulation.

Ranks ``0..draws`` of ``replications`` truths; under the hypothesis each is uniform on the ``draws + 1`` values and they
are independent. The ECDF band is that of Sailynoja, Burkner and Vehtari (2022): pointwise binomial intervals, widened
until all of them hold at once with the probability asked for. That probability is found exactly, by the recursion over
counts for a Poisson process in a corridor (Moscovich and Nadler 2017), so p-values far below 1 % are accurate.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from scipy.stats import binom, chi2, norm, poisson
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError

LEAST = 1e-15
"""Floor of pointwise probabilities: the corridor's own is accurate to only some 1e-12."""


def _counts(ranks: Tensor, draws: int) -> IntArray:
    """How often each rank occurs, ``(quantity, draws + 1)``."""
    if ranks.ndim != 2 or not len(ranks):
        raise InputError(f"ranks: found shape {tuple(ranks.shape)}, need (replication, quantity)")
    if int(ranks.min()) < 0 or int(ranks.max()) > draws:
        raise InputError(f"ranks: found {int(ranks.min())} to {int(ranks.max())}, need 0 to {draws}")
    return np.stack([np.bincount(column, minlength=draws + 1) for column in ranks.numpy().T])


def chi2_p_value(ranks: Tensor, draws: int, *, bins: int = 20) -> Tensor:
    """Pearson's chi^2 on ``bins`` equal bins of the ranks; p-values ``(quantity,)``.

    Raises:
        InputError: if ``draws + 1`` is no multiple of ``bins`` (bins would not be equally likely), or for ranks out of
            range.
    """
    if bins < 2 or (draws + 1) % bins:
        raise InputError(f"bins: found {bins}, need a divisor of draws + 1 = {draws + 1} of 2 or more")
    counts = _counts(ranks, draws)
    binned = counts.reshape(len(counts), bins, -1).sum(-1)
    expected = len(ranks) / bins
    return torch.from_numpy(chi2.sf(((binned - expected) ** 2 / expected).sum(-1), bins - 1))


def dispersion_p_value(ranks: Tensor, draws: int) -> Tensor:
    """Is the spread right? Mean squared normal score of the ranks against its law; two-sided p-values ``(quantity,)``.

    The sharpest of the three against a posterior that is too wide or too narrow: an SD wrong by a share ``d`` shifts it
    by about ``2 d``, with an error of ``sqrt(2 / replications)``. It is blind to a shift.
    """
    counts = _counts(ranks, draws)
    score = norm.ppf((np.arange(draws + 1) + 0.5) / (draws + 1)) ** 2
    found = counts @ score / len(ranks)
    return torch.from_numpy(2 * norm.sf(np.abs(found - score.mean()) / (score.std() / np.sqrt(len(ranks)))))


def ecdf_p_value(ranks: Tensor, draws: int) -> Tensor:
    """Probability that a uniform ECDF strays as far, by its least likely point; p-values ``(quantity,)``."""
    n, cdf = len(ranks), _cdf(draws)
    below = _counts(ranks, draws).cumsum(-1)[:, :-1]
    tails = np.minimum(binom.cdf(below, n, cdf), binom.sf(below - 1, n, cdf))
    outside = [1 - _within(*_open_corridor(n, draws, 2 * tail), n, draws) for tail in tails.min(-1)]
    return torch.tensor(outside, dtype=torch.float64).clamp(0, 1)


def ecdf_band(replications: int, draws: int, *, level: float = 0.95) -> tuple[Tensor, Tensor]:
    """Simultaneous band of the ECDF of uniform ranks: lower and upper at the ranks ``0..draws``, each ``(draws + 1,)``.

    A calibrated posterior's ECDF, ``mean(ranks <= r)``, lies in it for all ``r`` with probability ``level`` or a little
    more (counts are discrete).

    Raises:
        InputError: for ``level`` outside (0, 1), or no replications or draws.
    """
    if not 0 < level < 1:
        raise InputError(f"level: found {level}, need a number in (0, 1)")
    if replications < 1 or draws < 1:
        raise InputError(f"replications, draws: found {replications}, {draws}, need 1 or more")
    low, high = _band_counts(replications, draws, level)
    one = np.ones(1)
    return tuple(torch.from_numpy(np.concatenate([side / replications, one])) for side in (low, high))  # type: ignore[return-value]


def bonferroni(p_values: Tensor) -> float:
    """One p-value for many, valid under any dependence: the least times their number."""
    return float((p_values.min() * p_values.numel()).clamp_max(1.0))


def _cdf(draws: int) -> FloatArray:
    """CDF of a uniform rank at ``0..draws - 1``; at ``draws`` it is one whatever the posterior."""
    return np.arange(1, draws + 1) / (draws + 1)


@lru_cache(maxsize=64)
def _band_counts(n: int, draws: int, level: float) -> tuple[IntArray, IntArray]:
    # pointwise level: no higher than the simultaneous, no lower than Bonferroni's
    low, high = np.log((1 - level) / draws) - 1e-3, np.log1p(-level)
    for _ in range(40):
        middle = 0.5 * (low + high)
        inside = _within(*_open_corridor(n, draws, np.exp(middle)), n, draws)
        low, high = (middle, high) if inside >= level else (low, middle)
    return _open_corridor(n, draws, np.exp(low))


def _open_corridor(n: int, draws: int, pointwise: float) -> tuple[IntArray, IntArray]:
    """Least and greatest count at each rank whose two-sided pointwise p-value is above ``pointwise``."""
    cdf, pointwise = _cdf(draws), max(pointwise, LEAST)
    # ppf returns the least count with cdf >= q; shifted slightly because equality, which is outside, needs the next
    # count
    low = binom.ppf(0.5 * pointwise, n, cdf).astype(np.int64)
    low += binom.cdf(low, n, cdf) <= 0.5 * pointwise * (1 + 1e-9)
    high = binom.isf(0.5 * pointwise, n, cdf).astype(np.int64)
    high -= binom.sf(high - 1, n, cdf) <= 0.5 * pointwise * (1 + 1e-9)
    return np.clip(low, 0, n), np.clip(high, 0, n)


def _within(low: IntArray, high: IntArray, n: int, draws: int) -> float:
    """Probability that the cumulated counts of ``n`` uniform ranks stay in ``low..high`` at every rank.

    Counts of a multinomial are independent Poisson counts given their sum: walk through the ranks with Poisson
    increments, drop what leaves the corridor, and divide by the probability of the sum.
    """
    if bool((low > high).any()):
        return 0.0
    rate = n / (draws + 1)
    increment = poisson.pmf(np.arange(int(rate + 40 * np.sqrt(rate) + 40)), rate)
    state, first = np.ones(1), 0
    for least, greatest in zip(low, high, strict=True):
        state = np.convolve(state, increment)
        last = min(first + len(state) - 1, int(greatest))
        start = max(first, int(least))
        if start > last:
            return 0.0
        state, first = state[start - first : last - first + 1], start
    rest = n - first - np.arange(len(state))
    return float((state * poisson.pmf(rest, rate)).sum() / poisson.pmf(n, n))
