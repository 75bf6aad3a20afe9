"""Tests of uniform ranks: their level, the band, arviz beside it."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from benchmarks.uniformity import bonferroni, chi2_p_value, dispersion_p_value, ecdf_band, ecdf_p_value
from tests.bars import BAR

RUNS, N, DRAWS = 2000, 300, 19


@pytest.fixture
def uniform(rotating_seed, draws_factor) -> torch.Tensor:
    """Runs as quantities, so that one call tests them all."""
    return torch.from_numpy(np.random.default_rng(rotating_seed).integers(0, DRAWS + 1, (N, RUNS * draws_factor)))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("test", [chi2_p_value, ecdf_p_value, dispersion_p_value])
def test_level_is_kept(test, uniform):
    p = test(uniform, DRAWS)
    for level in (0.01, 0.05, 0.5):
        rejected = float((p <= level).double().mean())
        error = (level * (1 - level) / uniform.shape[1]) ** 0.5
        # counts are discrete, chi^2 and the normal are limits: a tenth of the level for that
        assert rejected <= 1.1 * level + BAR * error
        assert rejected >= 0.7 * level - BAR * error


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("level", [0.5, 0.95])
def test_band_holds_all_points_as_often_as_it_says(level, uniform):
    low, high = ecdf_band(N, DRAWS, level=level)
    counts = torch.stack([torch.bincount(r, minlength=DRAWS + 1) for r in uniform.T])
    ecdf = counts.cumsum(-1).double() / N
    inside = ((ecdf >= low - 1e-12) & (ecdf <= high + 1e-12)).all(-1)
    error = BAR * (level * (1 - level) / uniform.shape[1]) ** 0.5
    assert -error <= float(inside.double().mean()) - level <= 0.05 + error
    # the band and the p-value are one test
    assert ((ecdf_p_value(uniform, DRAWS) > 1 - level) == inside).double().mean() > 0.98


@pytest.mark.slow
def test_band_of_arviz_is_the_same():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # arviz announces its successor
        ecdf_utils = pytest.importorskip("arviz.stats.ecdf_utils")
        at = np.arange(1, 100) / 100
        expected = ecdf_utils.ecdf_confidence_band(500, at, at, prob=0.95, method="optimized")
    for ours, theirs in zip(ecdf_band(500, 99, level=0.95), expected, strict=True):
        # counts: which side of a step a bound lies on may differ
        assert np.abs(ours.numpy()[:-1] - theirs).max() <= 1.001 / 500


def test_small_case_by_enumeration():
    """Two ranks out of 0, 1, 2, all nine pairs: p-values are shares of pairs at least as unlikely."""
    pairs = torch.cartesian_prod(torch.arange(3), torch.arange(3)).T  # (replication, run)
    p = ecdf_p_value(pairs, 2)
    # at ranks 0 and 1 the counts are binomial(2, 1/3) and (2, 2/3); the extremes 2 and 0 have tail 1/9 each
    extreme = (pairs == 0).all(0) | (pairs == 2).all(0)
    assert p[extreme].tolist() == pytest.approx([2 / 9] * 2)
    assert (p[~extreme] > 2 / 9 + 1e-9).all()


@pytest.mark.statistical
def test_wrong_spread_and_wrong_place_are_seen(rotating_seed):
    """By normal scores stretched by 1.1 and shifted by 0.2: far below any level at 20 000 ranks."""
    g = torch.Generator().manual_seed(rotating_seed)
    score = torch.randn(20_000, generator=g, dtype=torch.float64)
    pit = torch.special.ndtr(torch.stack([1.1 * score, score / 1.1, score + 0.2], -1))
    ranks = (pit * 100).long()
    assert (chi2_p_value(ranks, 99) < 1e-6).all()
    assert (ecdf_p_value(ranks, 99) < 1e-6).all()
    spread = dispersion_p_value(ranks, 99)
    assert (spread[:2] < 1e-6).all()


def test_ranks_beyond_all_doubt():
    """All truths above all draws: tails that underflow are no obstacle."""
    p = ecdf_p_value(torch.full((20_000, 1), 99), 99)
    assert 0 <= float(p) < 1e-9


def test_bonferroni():
    assert bonferroni(torch.tensor([0.2, 0.01, 0.5])) == pytest.approx(0.03)
    assert bonferroni(torch.tensor([0.9, 0.8])) == 1.0


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: ecdf_band(10, 9, level=1.0), "level"),
        (lambda: ecdf_band(0, 9), "replications, draws"),
        (lambda: chi2_p_value(torch.zeros(5, 1, dtype=torch.long), 10), "bins"),
        (lambda: ecdf_p_value(torch.full((5, 1), 10), 9), "ranks"),
        (lambda: ecdf_p_value(torch.zeros(5, dtype=torch.long), 9), "ranks"),
    ],
)
def test_bad_arguments_are_refused_by_name(call, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        call()
