"""Simulation-based calibration: of exact toys, of toys with a fault, of windows and of the loop.

p-values are Bonferroni's over all quantities and tests, so each is one comparison.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import ExcitationRule, JerkDensity
from avtorch.inference.priors import LogNormalPrior
from avtorch.validation.windows import simulate_windows
from benchmarks.calibration import sbc, sbc_loop
from benchmarks.peers.conjugate import sample_conjugate
from benchmarks.rank_calibration import RankCalibration, sbc_quadrature
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
    ],
)
def test_bad_arguments_are_refused_by_name(call, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        call()


def test_statistics_are_those_of_the_samples():
    z = torch.tensor([[0.3, 1.0, 0.5]], dtype=F64).log()
    one, other = (statistics(z, rows=50, generator=torch.Generator().manual_seed(1)) for _ in range(2))
    assert one.jj.equal(other.jj)
    assert one.n.tolist() == [50]
