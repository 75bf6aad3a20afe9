"""No step size to tune: windows in unusual units and noise, default settings, compared with quadrature.

The prior's scales stay those of SI units, so a window in other units is merely a stranger car behind stranger noise:
its posterior may be unusual, and must be right. One that does not converge must report it, with the reason.
"""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from avtorch.inference import JerkDensity, JerkStatistics, Quadrature, SamplerSettings, find_mode, integrate, sample
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout
from tests.bars import BAR

pytestmark = pytest.mark.statistical

F64 = torch.float64
WINDOWS, ROWS = 50, 200
#: What the constant step may leave: of a mean and of an SD in SDs, of a probability.
BIAS, BIAS_OF_PROBABILITY = 0.03, 0.01


def strange(seed: int) -> JerkStatistics:
    """2 s windows, ``T_L`` 0.1 to 2 s, ``K_L`` 0.4 to 1.1, noise 0.01 to 5 m/s^3, all times 0.01 to 100."""
    g = torch.Generator().manual_seed(seed)

    def between(low: float, high: float) -> Tensor:
        return low * (high / low) ** torch.rand(WINDOWS, 1, generator=g, dtype=F64)

    factor, sigma, T, K = between(0.01, 100), between(0.01, 5), between(0.1, 2), between(0.4, 1.1)
    time = 0.01 * torch.arange(ROWS, dtype=F64)
    phase = 2 * torch.pi * torch.rand(2, WINDOWS, 1, generator=g, dtype=F64)
    u = torch.sin(2 * time + phase[0]) + 0.5 * torch.sin(5 * time + phase[1])
    later = glvd_rollout(u[:, 0], u, T[:, 0], K[:, 0], 0.01)
    a = torch.cat([u[:, :1], later[:, :-1]], -1)
    jerk = glvd_jerk(a, u, T, K) + sigma * torch.randn(u.shape, generator=g, dtype=F64)
    return JerkStatistics.from_samples(factor * a, factor * u, factor * jerk)


def kurtosis(truth: Quadrature) -> Tensor:
    """Of the exact marginals, ``(window, parameter)``: 3 for a normal."""
    score = (truth.nodes.exp() - truth.mean[..., None]) / truth.sd[..., None]
    return (truth.mass * score**4).sum(-1)


@pytest.mark.slow
def test_strange_units_and_noise(rotating_seed: int) -> None:
    """Mean, SD and three probabilities of every window, from the mode and from 3 SDs around it: 5 sigma and bias."""
    density = JerkDensity(strange(rotating_seed))
    mode = find_mode(density)
    truth = integrate(density, mode=mode, nodes=33)
    tail = kurtosis(truth)
    quantiles = {q: truth.quantile(q) for q in (0.05, 0.5, 0.95)}
    for spread in (0.0, 3.0):
        g = torch.Generator().manual_seed(rotating_seed)
        posterior = sample(density, SamplerSettings(spread=spread), generator=g, mode=mode)
        for converged, why in zip(posterior.converged.tolist(), posterior.why, strict=True):
            assert converged == (why == ""), why
        judged = posterior.converged & truth.converged
        assert judged.sum() >= WINDOWS - 5, posterior.why
        # the draws of the default settings are all but independent; half of them is on the safe side
        ess = 0.5 * posterior.draws.shape[0] * posterior.draws.shape[1]
        mean = ((posterior.mean - truth.mean) / truth.sd)[judged]
        assert mean.abs().max() < BIAS + BAR / math.sqrt(ess)
        for q, value in quantiles.items():
            below = (posterior.flat < value).double().mean(0)[judged]
            assert (below - q).abs().max() < BIAS_OF_PROBABILITY + BAR * math.sqrt(q * (1 - q) / ess)
        # a sample SD has a normal error only where the tails are not long
        short = judged[:, None] & (tail < 5)
        assert short.double().mean() > 0.5
        ratio = posterior.sd / truth.sd - 1
        assert (ratio.abs() < BIAS + BAR * ((tail - 1) / (4 * ess)).sqrt())[short].all()


def test_a_window_without_motion_settles_on_the_prior_or_gives_a_reason(rotating_seed: int) -> None:
    """Nothing moves, in any units: the noise is learnt, lag and gain are those of the prior."""
    g = torch.Generator().manual_seed(rotating_seed)
    still = torch.zeros(3, ROWS, dtype=F64)
    jerk = torch.tensor([[0.01], [1.0], [5.0]], dtype=F64) * torch.randn(3, ROWS, generator=g, dtype=F64)
    posterior = sample(JerkDensity(JerkStatistics.from_samples(still, still, jerk)), generator=g)
    for converged, why in zip(posterior.converged.tolist(), posterior.why, strict=True):
        assert converged or why
    z = posterior.draws.log()[:, :, posterior.converged]
    ess = 0.5 * z.shape[0] * z.shape[1]
    for i, (median, sd) in enumerate(((0.3, 0.7), (1.0, 0.3))):
        score = (z[..., i] - math.log(median)) / sd
        assert (score.mean((0, 1)).abs() < BIAS + BAR / math.sqrt(ess)).all()
        assert ((score.std((0, 1)) - 1).abs() < BIAS + BAR / math.sqrt(2 * ess)).all()
