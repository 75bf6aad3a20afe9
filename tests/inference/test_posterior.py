"""Summaries of draws, and the nested R-hat that tests them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avtorch.inference import Posterior, nested_rhat
from tests.bars import BAR

F64 = torch.float64


def normal(seed: int, *shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_moments_and_quantiles_are_numpys():
    draws = normal(0, 4, 25, 3, 2).exp()
    posterior = Posterior(("T_L", "K_L"), draws, torch.ones(3, dtype=torch.bool))
    flat = draws.reshape(100, 3, 2).numpy()
    np.testing.assert_allclose(posterior.mean.numpy(), flat.mean(0), rtol=1e-13)
    np.testing.assert_allclose(posterior.sd.numpy(), flat.std(0, ddof=1), rtol=1e-13)
    for q in (0.0, 0.05, 0.5, 0.95, 1.0):
        np.testing.assert_allclose(posterior.quantile(q).numpy(), np.quantile(flat, q, axis=0), rtol=1e-12)
    assert posterior["K_L"].equal(draws[..., 1])
    mean_z, cov_z = posterior.log_moments()
    np.testing.assert_allclose(mean_z.numpy(), np.log(flat).mean(0), rtol=1e-12)
    for w in range(3):
        np.testing.assert_allclose(cov_z[w].numpy(), np.cov(np.log(flat[:, w]).T), rtol=1e-12)


@pytest.mark.statistical
def test_rhat_of_one_law_is_one(rotating_seed):
    """sqrt(1 + 1/n) with n = 8 chains x 30 draws a superchain, give or take its chi square over 15 degrees."""
    rhat = nested_rhat(normal(rotating_seed, 64, 60, 40))
    assert rhat.shape == (40,)
    assert (rhat - 1).max() < 0.5 / 240 * (1 + BAR * math.sqrt(2 / 15) + BAR**2 / 15)


@pytest.mark.statistical
def test_rhat_detects_disagreement_and_drift(rotating_seed):
    draws = normal(rotating_seed, 64, 60, 5)
    draws[:8, :, 0] += 3.0  # one superchain elsewhere
    draws[:, :, 1] += torch.linspace(0, 4, 60, dtype=F64)  # all drift together
    draws[3, 7, 2] = math.nan
    draws[:, :, 3] = 1.0  # stuck together, at least in agreement
    rhat = nested_rhat(draws)
    assert rhat[0] > 1.1
    assert rhat[1] > 1.1
    assert not rhat[2] <= 1.1
    assert rhat[3] == 1.0
    assert rhat[4] < 1.1


@pytest.mark.statistical
@pytest.mark.parametrize("chains", [1, 2, 7, 8, 9])
def test_rhat_of_few_chains(chains, rotating_seed):
    assert nested_rhat(normal(rotating_seed, chains, 4000)).item() < 1.1
