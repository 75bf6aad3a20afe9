"""SGLD against independent reference draws, for posteriors unrelated to vehicles."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.inference import SamplerSettings, sample
from benchmarks.posteriordb import NAMES, density, reference
from tests.bars import BAR


@pytest.mark.statistical
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n == "arK-arK" else []) for n in NAMES])
def test_means_sds_and_quantiles_are_those_of_the_reference_draws(name, data_dir, rotating_seed, draws_factor):
    """5 sigma of both sets of draws, and 0.01 SDs (1 % of an SD) for the bias of the step.

    The reference draws count as independent: posteriordb keeps them only if they nearly are.
    """
    target, others = density(name, data_dir), reference(name, data_dir)
    settings = SamplerSettings(chains=2048 * draws_factor)
    posterior = sample(target, settings, generator=torch.Generator().manual_seed(rotating_seed))
    assert posterior.converged.all()
    assert set(target.names) == set(others)
    for parameter in target.names:
        theirs = others[parameter].flatten()
        center, scale = theirs.mean(), theirs.std()
        ours = (posterior[parameter][..., 0] - center) / scale
        # chains are independent of each other, whatever happens within them
        shift, wide = ours.mean(1), ours.square().mean(1)
        error = BAR * math.sqrt(1 / len(theirs) + shift.var().item() / len(shift))
        assert abs(shift.mean().item()) < error + 0.01, parameter
        # the variance's error from the fourth moment
        fourth = ((theirs - center) / scale).pow(4).mean().item()
        error = BAR * 0.5 * math.sqrt((fourth - 1) / len(theirs) + wide.var().item() / len(wide))
        assert abs(0.5 * (wide.mean().item() - 1)) < error + 0.01, parameter
        for q in (0.05, 0.25, 0.5, 0.75, 0.95):
            # share of each chain below their quantile; theirs has a binomial error of its own
            below = (posterior[parameter][..., 0] <= theirs.quantile(q)).double().mean(1)
            error = BAR * math.sqrt(q * (1 - q) / len(theirs) + below.var().item() / len(below))
            # 0.01 SDs of shift or width move at most 0.004 of the mass across a quantile
            assert abs(below.mean().item() - q) < error + 0.004, (parameter, q)
