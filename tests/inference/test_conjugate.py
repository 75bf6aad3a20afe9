"""The conjugate route against quadrature under every prior, and where it must report that it is not good enough."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avtorch.inference import JerkDensity, JerkStatistics
from avtorch.inference.priors import (
    Joint,
    LogNormalPrior,
    LogSpaceNormal,
    QuadrantNormal,
    default_jerk_noise_prior,
)
from avtorch.inference.quadrature import integrate
from benchmarks.peers.conjugate import sample_conjugate
from tests.bars import BAR

F64 = torch.float64
WINDOWS = 3


def priors() -> dict:
    belief = Joint(QuadrantNormal(torch.tensor([[0.4, 0.9]] * WINDOWS, dtype=F64), 0.25), default_jerk_noise_prior())
    cov = torch.tensor([[0.04, 0.01, 0.0], [0.01, 0.02, 0.0], [0.0, 0.0, 0.01]], dtype=F64).expand(WINDOWS, 3, 3)
    last = LogSpaceNormal(torch.tensor([[0.35, 0.9, 0.12]] * WINDOWS, dtype=F64).log(), cov)
    tight = LogNormalPrior(torch.tensor([0.25, 1.1, 0.1], dtype=F64), torch.tensor([0.05, 0.1, 0.5], dtype=F64))
    return {"first": None, "lambda": belief, "posterior": last, "log-normal": tight}


@pytest.mark.statistical
@pytest.mark.parametrize("name", list(priors()))
def test_draws_are_those_of_quadrature(name: str, make_windows, rotating_seed: int, draws_factor: int) -> None:
    w = make_windows(rotating_seed, [0.05, 0.4, 3.0], T=0.3, K=0.9, sigma=0.12)
    density = JerkDensity(w.statistics, priors()[name])
    exact = integrate(density)
    assert exact.converged.all()
    draws = 8000 * draws_factor
    found = sample_conjugate(density, draws=draws, generator=torch.Generator().manual_seed(rotating_seed))
    assert found.posterior.converged.all()
    assert found.posterior.draws.shape == (1, draws, WINDOWS, 3)
    error = (1 / found.ess + 1 / draws).sqrt()[:, None]  # of the weights, and of resampling
    assert (((found.posterior.mean - exact.mean) / exact.sd).abs() < BAR * error).all()
    # an SD's error is that of the squares: sqrt((kurtosis - 1) / 4), from the draws
    score = (found.posterior.flat - exact.mean) / exact.sd
    kurtosis = score.pow(4).mean(0)
    assert ((found.posterior.sd / exact.sd - 1).abs() < BAR * error * (0.25 * (kurtosis - 1)).sqrt() + 0.002).all()
    for q in (0.05, 0.5, 0.95):
        below = (found.posterior.flat < exact.quantile(q)).double().mean(0)
        assert ((below - q).abs() < BAR * error * (q * (1 - q)) ** 0.5).all()
    # and the comparison is worth making
    assert error.max() < 0.06


@pytest.mark.statistical
def test_least_squares_of_negative_lag(rotating_seed: int) -> None:
    """Sums that point to ``1/T_L = -0.1`` with an SD of 0.1: the draws are positive and those of quadrature."""
    n, sd = 200.0, 1.0
    size = (sd / 0.1) ** 2  # sum of squares of a, which makes the SD of 1/T
    noise = (n - 2) * sd**2
    b, g = -0.1, 0.3
    sums = dict(n=n, jj=size * (b**2 + g**2) + noise, aj=-b * size, uj=g * size, aa=size, au=0.0, uu=size)
    statistics = JerkStatistics(**{k: torch.tensor([v], dtype=F64) for k, v in sums.items()})
    assert statistics.least_squares()[0] == pytest.approx(b)
    density = JerkDensity(statistics)
    exact = integrate(density)
    found = sample_conjugate(
        density, proposals=400_000, draws=8000, generator=torch.Generator().manual_seed(rotating_seed)
    )
    assert found.posterior.converged.all()
    assert (found.posterior.draws > 0).all()
    error = (1 / found.ess + 1 / 8000).sqrt()[:, None]
    assert exact.converged.all()
    assert error.max() < 0.06
    assert (((found.posterior.mean - exact.mean) / exact.sd).abs() < BAR * error).all()


def test_a_prior_far_from_the_data_is_flagged(make_windows) -> None:
    """A prior that contradicts the window leaves few proposals of weight; a sound neighbour is unaffected."""
    w = make_windows(1, [2.0, 2.0], T=0.3)
    mean = torch.tensor([[3.0, 1.0, 0.1], [0.3, 1.0, 0.1]], dtype=F64).log()
    cov = torch.diag(torch.tensor([1e-6, 1.0, 1.0], dtype=F64)).expand(2, 3, 3)
    found = sample_conjugate(
        JerkDensity(w.statistics, LogSpaceNormal(mean, cov)), generator=torch.Generator().manual_seed(0)
    )
    assert found.posterior.converged.tolist() == [False, True]
    assert found.ess[0] < 400


@pytest.mark.statistical
def test_windows_without_information_give_the_prior(rotating_seed: int) -> None:
    """No command, no motion: least squares is undefined, ``T_L`` and ``K_L`` keep their prior."""
    g = torch.Generator().manual_seed(rotating_seed)
    zero = torch.zeros(1, 200, dtype=F64)
    density = JerkDensity(JerkStatistics.from_samples(zero, zero, torch.randn(1, 200, generator=g, dtype=F64)))
    found = sample_conjugate(density, draws=4000, proposals=40_000, generator=g)
    # some 4400 in the median; one proposal far out may weigh a lot (313 seen once), which is then said
    assert torch.equal(found.posterior.converged, found.ess >= 400)
    assert (found.ess > 50).all()
    z = found.posterior.flat[:, 0, :2].log()
    median, log_sd = torch.tensor([0.3, 1.0], dtype=F64), torch.tensor([0.7, 0.3], dtype=F64)
    error = float((1 / found.ess + 1 / 4000).sqrt())
    assert (((z.mean(0) - median.log()) / log_sd).abs() < BAR * error).all()
    assert ((z.std(0) / log_sd - 1).abs() < BAR * error).all()


def test_same_generator_same_draws_and_windows_do_not_mix(make_windows) -> None:
    w = make_windows(1, [0.3, 1.0])
    density = JerkDensity(w.statistics)
    first, again = (sample_conjugate(density, draws=500, generator=torch.Generator().manual_seed(7)) for _ in range(2))
    assert torch.equal(first.posterior.draws, again.posterior.draws)
    louder = replace(w.statistics, jj=w.statistics.jj * torch.tensor([1.0, 4.0], dtype=F64))
    other = sample_conjugate(JerkDensity(louder), draws=500, generator=torch.Generator().manual_seed(7))
    assert other.posterior.mean[1, 2] > 1.5 * first.posterior.mean[1, 2]
