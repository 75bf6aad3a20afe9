"""The posterior's mode as an estimator: the mode itself, close to quadrature, and its intervals' coverage."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from avtorch.inference import JerkDensity, JerkStatistics, find_mode, integrate
from avtorch.inference.estimators import MaximumAPosteriori
from avtorch.inference.latent import LatentDensity, default_noise_prior
from avtorch.inference.priors import Joint, default_actuation_prior, default_jerk_noise_prior
from avtorch.vehicle.glvd import glvd_jerk
from tests.bars import BAR
from tests.inference.latent_windows import drawn_window

F64 = torch.float64


def updated(statistics, **options):
    count = len(statistics.n)
    loop = MaximumAPosteriori(vehicles=count, **options)
    return loop.update(lambda i, prior: JerkDensity(statistics.select(i), prior), torch.ones(count, dtype=torch.bool))


def test_its_median_is_the_mode(make_windows):
    statistics = make_windows(3, [1.0, 0.1]).statistics
    belief = updated(statistics)
    mode = find_mode(JerkDensity(statistics))
    torch.testing.assert_close((belief.q05 * belief.q95).sqrt(), mode.z.exp(), rtol=1e-10, atol=0)
    torch.testing.assert_close((belief.q95 / belief.q05).log() / 2 / 1.6448536269514722, _sd(mode), rtol=1e-10, atol=0)


@pytest.mark.slow
def test_without_measured_jerk_its_median_is_the_mode_too(fresh_seed):
    """The mode is sought by values there, and lies within a hundredth of an SD of that sought by derivatives."""
    density, _ = drawn_window(torch.Generator().manual_seed(fresh_seed), accel=True, speed=True, rows=100, dt=0.02)
    likelihood = partial(LatentDensity, density.data)
    belief = MaximumAPosteriori(names=density.names, noise_prior=default_noise_prior(density.names[2:])).update(
        lambda i, prior: likelihood(prior), torch.ones(1, dtype=torch.bool)
    )
    mode = find_mode(LatentDensity(density.data))
    off = torch.linalg.solve_triangular(
        mode.scale, ((belief.q05 * belief.q95).sqrt().log() - mode.z)[..., None], upper=False
    )
    assert float(off.norm()) < 1e-2


def _sd(mode):
    return mode.covariance.diagonal(dim1=-2, dim2=-1).sqrt()


@pytest.mark.statistical
def test_an_informative_window_agrees_with_quadrature(make_windows, rotating_seed):
    statistics = make_windows(rotating_seed, [1.0, 0.6]).statistics
    belief, exact = updated(statistics), integrate(JerkDensity(statistics))
    off = (belief.mean - exact.mean).abs() / exact.sd
    # T_L and K_L have relative SDs of 1 %, and a skewness of that order
    assert off[:, :2].max() < 0.05
    # sigma^2 is nearly inverse gamma of shape n/2: log sigma has SD 1/sqrt(2n), its mean lies 1.5/n beyond the mode
    assert off[:, 2].max() < 1.1 * 1.5 * math.sqrt(2 / 200)
    assert (belief.sd / exact.sd - 1).abs().max() < 0.05


@pytest.mark.statistical
def test_intervals_cover_truths_of_the_prior(rotating_seed, draws_factor):
    """1000 vehicles drawn from the prior, 200 well excited rows: 90 % of their parameters lie in the 90 % intervals."""
    count, g = 1000 * draws_factor, torch.Generator().manual_seed(rotating_seed)
    prior = Joint(default_actuation_prior(), default_jerk_noise_prior())
    truth = prior.sample(1, count, generator=g)[0].exp()
    a, u = torch.randn(2, count, 200, generator=g, dtype=F64)
    noise = torch.randn(count, 200, generator=g, dtype=F64)
    jerk = glvd_jerk(a, u, truth[:, :1], truth[:, 1:2]) + truth[:, 2:] * noise
    belief = updated(JerkStatistics.from_samples(a, u, jerk), kept=2)
    assert belief.converged.all()
    covered = ((belief.q05 <= truth) & (truth <= belief.q95)).double().mean(0)
    # the law of the posterior mean over the prior makes this exact but for Laplace's error, below 0.01 at 200 rows
    assert ((covered - 0.9).abs() < BAR * math.sqrt(0.09 / count) + 0.01).all()
