"""Divergences of Gaussians against independent computations, and the false-alarm rate of their thresholds."""

import math

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from scipy.stats import chi2
from torch.distributions import MultivariateNormal, kl_divergence

from avtorch.decision.divergence import (
    DIVERGENCES,
    Gaussian,
    divergence,
    divergence_p_value,
    hellinger,
    innovation,
    kl,
    w2,
    weighted_chi2_tail,
)
from avtorch.errors import InputError
from tests.bars import BAR


def random_gaussian(batch, generator, scale=1.0):
    root = torch.randn(batch, 2, 2, generator=generator, dtype=torch.float64)
    cov = root @ root.mT + 0.2 * torch.eye(2, dtype=torch.float64)
    return Gaussian(torch.randn(batch, 2, generator=generator, dtype=torch.float64), scale**2 * cov)


@pytest.fixture
def pair(fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    return random_gaussian(6, generator), random_gaussian(6, generator)


def test_kl_against_torch(pair):
    p, q = pair
    other = kl_divergence(MultivariateNormal(p.mean, p.cov), MultivariateNormal(q.mean, q.cov))
    torch.testing.assert_close(kl(p, q), other, rtol=1e-10, atol=1e-12)


def test_hellinger_against_quadrature(pair):
    p, q = pair
    # The integrand sqrt(p q) is a Gaussian: on a fine grid the trapezium rule is exact to rounding.
    axis = torch.linspace(-30.0, 30.0, 1201, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(axis, axis, indexing="ij"), dim=-1).reshape(-1, 2)
    for i in range(2):
        logs = [MultivariateNormal(g.mean[i], g.cov[i]).log_prob(grid) for g in (p, q)]
        overlap = float((0.5 * (logs[0] + logs[1])).exp().sum()) * 0.05**2
        assert float(hellinger(p, q)[i]) == pytest.approx(math.sqrt(1.0 - overlap), abs=1e-8)


def test_w2_against_scipy(pair):
    p, q = pair
    for i in range(6):
        P, Q = p.cov[i].numpy(), q.cov[i].numpy()
        root = sqrtm(Q)
        squared = np.sum((p.mean[i] - q.mean[i]).numpy() ** 2) + np.trace(P + Q - 2 * np.real(sqrtm(root @ P @ root)))
        assert float(w2(p, q)[i]) == pytest.approx(math.sqrt(squared), rel=1e-7)


@pytest.mark.parametrize("kind", DIVERGENCES)
def test_a_belief_does_not_diverge_from_itself(kind, pair):
    assert float(divergence(kind, pair[0], pair[0]).abs().max()) < 1e-6


def test_tail_of_weighted_chi_squares():
    value = torch.tensor([0.3, 2.0, 9.0, 25.0], dtype=torch.float64)
    equal = weighted_chi2_tail(value, torch.tensor([1.7, 1.7], dtype=torch.float64))
    torch.testing.assert_close(equal, torch.exp(-value / 3.4), rtol=1e-12, atol=0.0)
    single = weighted_chi2_tail(value, torch.tensor([0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(single, torch.from_numpy(chi2.sf(value.numpy(), 1)), rtol=1e-2, atol=1e-12)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", DIVERGENCES)
@pytest.mark.parametrize("baseline_scale", [0.1, 1.0, 3.0])
def test_false_alarm_rate_counts_the_baselines_own_uncertainty(kind, baseline_scale, rotating_seed, draws_factor):
    generator = torch.Generator().manual_seed(rotating_seed)
    n, rate = 20000 * draws_factor, 0.05
    p, q = (random_gaussian(1, generator, s) for s in (1.0, baseline_scale))

    def around_the_truth(g):
        noise = torch.randn(n, 2, generator=generator, dtype=torch.float64)
        return Gaussian(noise @ torch.linalg.cholesky(g.cov[0]).mT, g.cov.expand(n, 2, 2))

    chance = divergence_p_value(kind, around_the_truth(p), around_the_truth(q))
    share = float((chance < rate).double().mean())
    assert abs(share - rate) < BAR * math.sqrt(rate * (1.0 - rate) / n)


@pytest.mark.statistical
def test_combined_beliefs_add_their_precisions_and_leave_white_residuals(rotating_seed, draws_factor):
    generator = torch.Generator().manual_seed(rotating_seed)
    a, b = random_gaussian(4, generator), random_gaussian(4, generator)
    both = a.combine(b)
    precision = torch.linalg.inv(a.cov) + torch.linalg.inv(b.cov)
    torch.testing.assert_close(torch.linalg.inv(both.cov), precision, rtol=1e-9, atol=1e-9)
    pulled = torch.linalg.inv(a.cov) @ a.mean[..., None] + torch.linalg.inv(b.cov) @ b.mean[..., None]
    torch.testing.assert_close(precision @ both.mean[..., None], pulled, rtol=1e-9, atol=1e-9)

    n = 20000 * draws_factor
    cov = a.cov[:1].expand(n, 2, 2)
    windows = [
        Gaussian(torch.randn(n, 2, generator=generator, dtype=torch.float64) @ torch.linalg.cholesky(cov[0]).mT, cov)
        for _ in range(3)
    ]
    baseline, residuals = windows[0], []
    for window in windows[1:]:
        residuals.append(innovation(window, baseline))
        baseline = baseline.combine(window)
    z = torch.cat(residuals, dim=-1)
    # Covariance of n standard normal vectors: entries off the identity by sqrt(2/n) at most, 1 sigma.
    assert float((z.mT @ z / n - torch.eye(4, dtype=torch.float64)).abs().max()) < BAR * math.sqrt(2.0 / n)


def test_too_few_draws_are_refused():
    with pytest.raises(InputError, match="draws"):
        Gaussian.of_draws(torch.ones(4, 2), torch.ones(4, 2))
