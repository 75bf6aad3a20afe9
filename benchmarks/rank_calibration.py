"""Simulation-based calibration: do intervals cover the truth as often as stated?

Draw a truth from the prior, simulate a window from it, sample its posterior: the truth is then one more draw from that
posterior, so its rank among them is uniform (Talts et al. 2018). This holds for any function of truth and data, and the
log likelihood of the data reveals faults that the ranks of single parameters do not (Modrak et al. 2023). It also holds
given earlier data, if the truth is drawn from the posterior at that point (posterior SBC, Sailynoja et al. 2025): this
tests a loop whose prior assumes that the vehicle changes; `benchmarks/calibration.py` does so, and ranks SGLD.
Ranks stay uniform under any selection that depends on data alone (excited windows, settled chains).

The package ``simuk`` does SBC for PyMC, Bambi and NumPyro models, one fit after another in a Python loop. Our densities
are not such models, and all replications are windows of one tensor; so the ranks are computed here, in a few lines.

Are the ranks uniform? Three tests of one hypothesis, and the simultaneous band of the ECDF, all without simulation.
Ranks ``0..draws`` of ``replications`` truths; under the hypothesis each is uniform on the ``draws + 1`` values and they
are independent. The ECDF band is that of Sailynoja, Burkner and Vehtari (2022): pointwise binomial intervals, widened
until all of them hold at once with the probability asked for. That probability is found exactly, by the recursion over
counts for a Poisson process in a corridor (Moscovich and Nadler 2017), so p-values far below 1 % are accurate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
import torch
from scipy.stats import binom, chi2, norm, poisson
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.errors import InputError
from avtorch.inference.jerk import JerkDensity
from avtorch.inference.priors import Joint, Prior, default_actuation_prior, default_jerk_noise_prior
from avtorch.inference.quadrature import integrate
from benchmarks.sine_windows import Amplitude, statistics

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
            draws: draws that a rank counts, spread over chains and time to be nearly independent.
            inflate: stretch the draws about their mean in ``z`` by this factor, a fault that the tests must detect.
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


VARIED = (0.1, 2.0)
"""Amplitudes [m/s^2] from weak to strong excitation."""

BATCH = 500
"""Windows drawn, and vehicles tracked, at once."""
QUADRATURE_BATCH = 20
"""Windows integrated at once: more would exceed the cache."""


def sbc_quadrature(
    replications: int = 2000,
    *,
    amplitude: Amplitude = VARIED,
    draws: int = 99,
    seed: int = 0,
) -> RankCalibration:
    """Calibration of a single window's exact posterior, by quadrature, for the parameters only.

    Windows for which 31 nodes are too few are included in the figures. Ranks are ``below`` in ``draws + 1`` steps.

    Args:
        replications: truths drawn from the prior, each with a window of its own.
        amplitude: excitation of the windows [m/s^2], see :func:`statistics`.

    Raises:
        InputError: for ``draws`` that 20 bins do not divide, or ``replications`` not positive.
    """
    check_sizes(replications, draws)
    parts = []
    for density, truth in drawn_windows(replications, BATCH, amplitude, None, seed):
        few = [density.select(index) for index in torch.arange(density.windows).split(QUADRATURE_BATCH)]
        values = truth.exp().split(QUADRATURE_BATCH)
        below = torch.cat([integrate(d, nodes=31).cdf(v) for d, v in zip(few, values, strict=True)])
        ranks = (below * (draws + 1)).long().clamp(0, draws)
        parts.append(RankCalibration(density.names, ranks, draws, below))
    return joined(parts)


def drawn_windows(
    replications: int, batch: int, amplitude: Amplitude, prior: Prior | None, seed: int
) -> Iterator[tuple[JerkDensity, Tensor]]:
    """Batches of windows and the truths ``z`` they were drawn from; nothing else draws from their generator."""
    prior = Joint(default_actuation_prior(), default_jerk_noise_prior()) if prior is None else prior
    generator = torch.Generator().manual_seed(seed)
    for count in batches(replications, batch):
        truth = prior.sample(1, count, generator=generator)[0]
        yield JerkDensity(statistics(truth, amplitude=amplitude, generator=generator), prior), truth


def check_sizes(replications: int, draws: int = 99, inflate: float = 1.0, batch: int = BATCH) -> None:
    """Raises `InputError` for sizes out of range, by name."""
    if replications < 1 or batch < 1:
        raise InputError(f"replications, batch: found {replications}, {batch}, need 1 or more")
    if draws < 19 or (draws + 1) % 20:
        raise InputError(f"draws: found {draws}, need a multiple of 20 less 1, for 20 equal bins of ranks")
    if not inflate > 0:
        raise InputError(f"inflate: found {inflate}, need a positive factor")


def batches(total: int, size: int = BATCH) -> list[int]:
    """`total` in parts of `size`, and what is left."""
    return [min(size, total - first) for first in range(0, total, size)]


def joined(parts: list[RankCalibration]) -> RankCalibration:
    """The replications of several calibrations as one."""
    first = parts[0]
    ranks, below = (torch.cat([getattr(p, key) for p in parts]) for key in ("ranks", "below"))
    return RankCalibration(first.names, ranks, first.draws, below, sum(p.dropped for p in parts))


# Are ranks uniform? Three tests of one hypothesis, and the simultaneous band of the ECDF, all without simulation.
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
