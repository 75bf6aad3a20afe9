"""Calibration: uniform ranks, SBC of a window and of the loop, and the loop against one inference on all windows."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import ExcitationRule, JerkDensity, JerkStatistics, integrate
from avtorch.inference.priors import LogNormalPrior
from avtorch.validation.windows import simulate_windows
from benchmarks.calibration import sbc, sbc_loop
from benchmarks.peers.conjugate import sample_conjugate
from benchmarks.pooled import (
    FreeNoise,
    PooledComparison,
    constant,
    drift,
    pool,
    step,
    track_loop,
    truth_given_all,
    windows_of,
)
from benchmarks.rank_calibration import (
    RankCalibration,
    bonferroni,
    chi2_p_value,
    dispersion_p_value,
    ecdf_band,
    ecdf_p_value,
    sbc_quadrature,
)
from benchmarks.sine_windows import sine_commands, statistics
from tests.bars import BAR, LEVEL

F64 = torch.float64


class Toy:
    """``theta ~ N(0, 1)``, ``y ~ N(theta, 1)``: the posterior is ``N(y/2, 1/2)``; ``z`` is ``theta``."""

    names = ("theta",)

    def __init__(self, y: Tensor) -> None:
        self.y = y

    def log_likelihood(self, z: Tensor) -> Tensor:
        return -0.5 * (self.y - z[..., 0]).square()

    def log_prob(self, z: Tensor) -> Tensor:
        return self.log_likelihood(z) - 0.5 * z[..., 0].square()


def toy(seed: int, count: int, *, stretch: float = 1.0, shift: float = 0.0, inflate: float = 1.0) -> RankCalibration:
    g = torch.Generator().manual_seed(seed)
    truth = torch.randn(count, 1, generator=g, dtype=F64)
    y = truth[:, 0] + torch.randn(count, generator=g, dtype=F64)
    noise = torch.randn(99, count, generator=g, dtype=F64)
    draws = y / 2 + math.sqrt(0.5) * (stretch * noise + shift)
    return RankCalibration.of(Toy(y), truth, draws.unsqueeze(-1).exp(), inflate=inflate)


@pytest.mark.statistical
def test_exact_posterior_has_uniform_ranks(rotating_seed, draws_factor):
    found = toy(rotating_seed, 4000 * draws_factor)
    assert found.names == ("theta", "log_likelihood", "log_posterior")
    assert found.p_value > LEVEL
    for level, share in found.coverage.items():
        # 99 draws: the interval's ends are a percent apart
        assert ((share - level).abs() < BAR * found.coverage_error(level) + 0.01).all()
    low, high = found.ecdf_band(1 - LEVEL)
    assert (found.ecdf[:, -1] == 1).all()
    assert ((low <= found.ecdf) & (found.ecdf <= high)).all()


@pytest.mark.statistical
@pytest.mark.parametrize("fault", [{"stretch": 1.1}, {"stretch": 1 / 1.1}, {"shift": 0.15}, {"inflate": 1.1}])
def test_fault_of_a_tenth_is_seen(fault, rotating_seed):
    """At 10 000 ranks the spread's statistic lies 12 sigma off."""
    assert toy(rotating_seed, 10_000, **fault).p_value < 0.01


@pytest.mark.statistical
def test_inflation_stretches_about_the_mean_of_the_logarithm(rotating_seed):
    """On a toy that is normal in ``z`` it is the same as drawing with the wider SD, but for the mean of the draws."""
    wide, stretched = toy(rotating_seed, 500, stretch=1.5), toy(rotating_seed, 500, inflate=1.5)
    # the mean of 99 draws is off by a tenth of an SD, stretched by half: ranks differ by a few
    assert (wide.ranks - stretched.ranks)[:, 0].abs().double().mean() < 5


def test_ranks_of_known_draws():
    draws = torch.arange(1.0, 20.0, dtype=F64).reshape(19, 1, 1).expand(-1, 2, -1)
    truth = torch.tensor([[5.5], [0.5]], dtype=F64).log()
    found = RankCalibration.of(Toy(torch.zeros(2, dtype=F64)), truth, draws, torch.tensor([True, False]), draws=19)
    assert found.replications == 1
    assert found.dropped == 1
    # the nearer to zero in z, the likelier; only log 1 to log 5 are likelier than log 5.5
    assert found.ranks.tolist() == [[5, 14, 14]]
    assert found.below[0, 0] == pytest.approx(5 / 19)
    assert found.counts(20).sum(-1).tolist() == [1, 1, 1]


@pytest.mark.statistical
def test_acceleration_moves_by_the_measured_jerk(rotating_seed, draws_factor):
    g = torch.Generator().manual_seed(rotating_seed)
    z = torch.tensor([[0.3, 1.0, 0.5], [0.003, 0.8, 0.1]], dtype=F64).log()
    u = sine_commands(2, 20_000 * draws_factor, (0.1, 2.0), generator=g)
    a, jerk = simulate_windows(z, u, generator=g)
    assert torch.allclose(a[0, 1:], a[0, :-1] + 0.01 * jerk[0, :-1], atol=1e-9)
    # a lag below the step is held for as long as the lag, and stays finite
    assert torch.allclose(a[1, 1:], a[1, :-1] + 0.003 * jerk[1, :-1], atol=1e-9)
    T, K, sigma = z.exp().unbind(-1)
    noise = (jerk - (K[:, None] * u - a) / T[:, None]).std(-1)
    assert ((noise / sigma - 1).abs() < BAR / math.sqrt(2 * u.shape[-1])).all()


@pytest.mark.statistical
def test_amplitudes_span_their_range(rotating_seed):
    g = torch.Generator().manual_seed(rotating_seed)
    reach = sine_commands(2000, 1000, (0.1, 2.0), generator=g).abs().amax(-1)
    assert 0.05 < reach.min() < 0.2
    assert 2.0 < reach.max() < 3.0 + 1e-9


@pytest.mark.statistical
@pytest.mark.slow
def test_windows_are_calibrated_and_the_stretched_are_not(rotating_seed):
    assert sbc(300, seed=rotating_seed).p_value > LEVEL
    # an SD too wide by 1.4 puts the spread's statistic of each parameter six sigma off at 300
    assert sbc(300, inflate=1.4, seed=rotating_seed).p_value < 0.01


@pytest.mark.slow
@pytest.mark.statistical
def test_another_prior_and_an_exact_sampler(rotating_seed):
    prior = LogNormalPrior(torch.tensor([0.6, 0.8, 0.2]), torch.tensor([0.3, 0.2, 0.5]))

    def exact(density: JerkDensity, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        posterior = sample_conjugate(density, draws=990, proposals=8000, least_ess=300, generator=generator).posterior
        return posterior.flat, posterior.converged

    found = sbc(300, prior=prior, sampler=exact, draws=19, seed=rotating_seed)
    assert found.p_value > LEVEL
    assert found.dropped < 30


@pytest.mark.slow
@pytest.mark.statistical
def test_sgld_and_quadrature_see_the_same_windows(rotating_seed):
    ours, exact = sbc(30, seed=rotating_seed), sbc_quadrature(30, seed=rotating_seed)
    assert exact.names == ours.names[:3]
    # at least a thousand effective draws
    assert (ours.below[:, :3] - exact.below).abs().max() < BAR * 0.5 / math.sqrt(1000)
    assert exact.ranks.tolist() == (exact.below * 100).long().tolist()


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("mode", ["posterior", "lambda", "forgetting"])
def test_the_loop_is_calibrated(mode, rotating_seed):
    found = sbc_loop(120, windows=3, mode=mode, amplitude=1.0, seed=rotating_seed)
    assert len(found) == 3
    for calibration in found:
        assert calibration.replications + calibration.dropped == 120
        assert calibration.p_value > LEVEL


@pytest.mark.statistical
def test_windows_that_are_not_excited_are_not_ranked(rotating_seed):
    found = sbc_loop(60, windows=2, mode="lambda", amplitude=(0.01, 1.0), rule=ExcitationRule(), seed=rotating_seed)
    for calibration in found:
        assert 0 < calibration.replications + calibration.dropped < 60


@pytest.mark.statistical
@pytest.mark.slow
def test_a_prior_that_claims_too_much_is_seen(rotating_seed):
    """A truth that stays, and a ``lambda`` that puts it within 0.01 of the last mean, whose own SD is more."""
    found = sbc_loop(200, windows=2, mode="lambda", lam=1e-4, truth="constant", amplitude=0.3, seed=rotating_seed)
    assert found[0].p_value > LEVEL
    assert found[1].p_value < 1e-4


def test_statistics_are_those_of_the_samples():
    z = torch.tensor([[0.3, 1.0, 0.5]], dtype=F64).log()
    one, other = (statistics(z, rows=50, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    assert one.jj.equal(other.jj)
    assert one.n.tolist() == [50]


# Tests of uniform ranks: their level, the band, arviz beside it.
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


# The loop against one inference on all windows, and on vehicles that change.
def fleet(count: int) -> torch.Tensor:
    """Vehicles with well resolved windows: ``log(T_L, K_L, sigma)``."""
    share = torch.linspace(0, 1, count, dtype=F64)
    return torch.stack([0.3 + 0.7 * share, 1.0 - 0.4 * share, 0.1 + 0.0 * share], -1).log()


def test_sums_of_windows_are_sums_of_all_rows(fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    z = fleet(3)
    rows = [
        (*simulate_windows(z, u, generator=g), u) for u in (sine_commands(3, 50, 1.0, generator=g) for _ in range(4))
    ]
    parts = [JerkStatistics.from_samples(a, u, jerk) for a, jerk, u in rows]
    a, jerk, u = (torch.cat(column, -1) for column in zip(*rows, strict=True))
    whole = JerkStatistics.from_samples(a, u, jerk)
    for name in ("n", "jj", "aj", "uj", "aa", "au", "uu"):
        assert torch.allclose(getattr(pool(parts), name), getattr(whole, name), rtol=1e-10)


@pytest.mark.parametrize("amplitude", [1.0, 0.2])
def test_one_window_with_a_sigma_of_its_own_is_that_window(amplitude, fresh_seed):
    """With one window both are the same posterior: that of the vehicle with sigma integrated out."""
    g = torch.Generator().manual_seed(fresh_seed)
    (seen,) = windows_of(constant(fleet(4), 1), amplitude=amplitude, generator=g)
    free, whole = integrate(FreeNoise([seen])), integrate(JerkDensity(seen))
    assert torch.allclose(free.log_evidence, whole.log_evidence, atol=1e-5)
    assert ((free.mean - whole.mean[:, :2]) / free.sd).abs().max() < 1e-4
    assert torch.allclose(free.sd, whole.sd[:, :2], rtol=1e-4)


def test_selected_vehicles_keep_their_density(fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    density = FreeNoise(windows_of(constant(fleet(3), 2), generator=g))
    z = fleet(3)[:, :2]
    index = torch.tensor([2, 0])
    assert density.select(index).log_prob(z[index]).equal(density.log_prob(z)[index])
    assert density.constrain(z).equal(z.exp())


@pytest.mark.statistical
def test_posterior_mode_ends_where_the_pooled_posterior_is(rotating_seed):
    """Four well excited windows.

    Each step carries on the moments of at least a thousand effective draws, an error of 1/sqrt(1000) SD in the mean:
    after four steps 5 sigma are 0.32 SD, and in the SD of the last step 0.11. The normal itself errs by the skewness of
    a well excited window's posterior, which is of order SD/T, below 0.1.
    """
    g = torch.Generator().manual_seed(rotating_seed)
    path = constant(fleet(10), 4)
    seen = windows_of(path, generator=g)
    pooled = truth_given_all(seen)
    found = PooledComparison.of(track_loop(path, seen, mode="posterior", seed=rotating_seed), pooled)
    assert pooled.converged.all()
    assert found.shift.abs().max() < 0.32 + 0.1
    assert (found.sd_ratio - 1).abs().max() < 0.11 + 0.1
    # lambda I forgets all but the last of four windows: twice the SD, within what windows of other phases differ
    loose = PooledComparison.of(track_loop(path, seen, mode="lambda", seed=rotating_seed), pooled)
    assert 1.5 < loose.sd_ratio[:, :2].median() < 2.8


@pytest.mark.statistical
def test_a_sigma_of_its_own_for_every_window_costs_little(rotating_seed):
    """Where all windows have the same sigma, letting it vary loses of order one part in 2 n of the information."""
    g = torch.Generator().manual_seed(rotating_seed)
    seen = windows_of(constant(fleet(5), 3), generator=g)
    shared, free = truth_given_all(seen), truth_given_all(seen, shared_noise=False)
    assert free.names == ("T_L", "K_L")
    assert ((free.sd / shared.sd[:, :2]) - 1).abs().max() < 0.15


def test_paths():
    z, later = fleet(2), fleet(2) + 1
    stays, steps = constant(z, 4), step(z, later, 4, at=3)
    assert stays.shape == (4, 2, 3)
    assert steps[2].equal(z)
    assert steps[3, :, :2].equal(later[:, :2])
    assert steps[3, :, 2].equal(z[:, 2])
    rate = torch.tensor([[0.1, -0.1]], dtype=F64).expand(2, 2)
    drifts = drift(z, rate, 4)
    assert torch.allclose(drifts[3] - z, torch.tensor([0.3, -0.3, 0.0], dtype=F64).expand(2, 3))


@pytest.mark.statistical
def test_lambda_follows_a_step_that_posterior_mode_does_not(rotating_seed):
    g = torch.Generator().manual_seed(rotating_seed)
    z = torch.tensor([[0.3, 1.0, 0.1]], dtype=F64).log().expand(10, -1)
    later = torch.tensor([[1.0, 0.6, 0.1]], dtype=F64).log().expand(10, -1)
    path = step(z, later, 4, at=3)
    seen = windows_of(path, generator=g)
    follows, stays = (track_loop(path, seen, mode=mode, seed=rotating_seed) for mode in ("lambda", "posterior"))
    assert follows.covered.shape == (4, 10, 3)
    # an SD of about 3 %; posterior mode is between three windows at 0.3 s and one at 1 s
    assert follows.relative_error[-1, :, 0].median() < 0.2
    assert stays.relative_error[-1, :, 0].median() > 0.3
    assert math.isclose(float(follows.truth[-1, 0, 0]), 1.0)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: sbc(0), "replications, batch"),
        (lambda: sbc(10, batch=0), "replications, batch"),
        (lambda: sbc(10, draws=100), "draws"),
        (lambda: sbc(10, inflate=0.0), "inflate"),
        (lambda: sbc(10, amplitude=(2.0, 1.0)), "amplitude"),
        (lambda: sbc_quadrature(10, draws=0), "draws"),
        (lambda: sbc_loop(10, truth="drawn"), "truth"),
        (lambda: sbc_loop(10, mode="all"), "mode"),
        (lambda: simulate_windows(torch.zeros(3, 2), torch.zeros(3, 5)), "z, u"),
        (lambda: ecdf_band(10, 9, level=1.0), "level"),
        (lambda: ecdf_band(0, 9), "replications, draws"),
        (lambda: chi2_p_value(torch.zeros(5, 1, dtype=torch.long), 10), "bins"),
        (lambda: ecdf_p_value(torch.full((5, 1), 10), 9), "ranks"),
        (lambda: ecdf_p_value(torch.zeros(5, dtype=torch.long), 9), "ranks"),
        (lambda: pool([]), "windows"),
        (lambda: track_loop(constant(fleet(2), 3), windows_of(constant(fleet(2), 2)), mode="lambda"), "path, windows"),
    ],
)
def test_bad_arguments_are_refused_by_name(call, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        call()
