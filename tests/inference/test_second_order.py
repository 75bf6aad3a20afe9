"""Second-order lags by the same sampler: the density as it is written, quadrature, coverage, the stream."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import Normal

from avtorch.inference import BeliefStream, SamplerSettings, integrate, sample
from avtorch.inference.second_order_form import PositionLagForm, SpeedLagForm
from avtorch.vehicle.second_order import position_lag_accel, speed_lag_accel
from benchmarks.second_order import PRIOR, density_of, drive, vehicles_of
from tests.bars import BAR

F64 = torch.float64
KINDS = ["speed", "position"]
FORM = {"speed": SpeedLagForm, "position": PositionLagForm}


TRUTH = torch.tensor([[0.4, 0.95, 0.1], [1.2, 0.8, 0.4]], dtype=F64)


@pytest.mark.parametrize("kind", KINDS)
def test_the_density_is_the_sum_over_rows(kind, fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    _, columns = drive(kind, TRUTH, g)
    density = density_of(kind, columns)
    z = TRUTH.log() + 0.1 * torch.randn(5, 2, 3, generator=g, dtype=F64)
    first, second, sigma = z.exp().unsqueeze(-1).unbind(-2)
    if kind == "speed":
        mean = speed_lag_accel(columns["speed"], columns["speed_cmd"], first, second)
    else:
        mean = position_lag_accel(columns["position_cmd"] - columns["position"], columns["speed"], first, second)
    exact = Normal(mean, sigma).log_prob(columns["accel"]).sum(-1) + density.prior.log_prob(z)
    torch.testing.assert_close(density.log_prob(z), exact, rtol=1e-9, atol=1e-7)
    z.requires_grad_()
    (slope,) = torch.autograd.grad(density.log_prob(z).sum(), z)
    torch.testing.assert_close(density.score(z.detach()), slope, rtol=1e-7, atol=1e-6)


@pytest.mark.statistical
@pytest.mark.parametrize("kind", KINDS)
def test_sgld_is_quadrature_s(kind, rotating_seed):
    g = torch.Generator().manual_seed(rotating_seed)
    density = density_of(kind, drive(kind, TRUTH, g)[1])
    exact, found = integrate(density), sample(density, generator=g)
    assert exact.converged.all()
    assert found.converged.all()
    # 8192 draws with an autocorrelation time of about two: 5 sigma of a mean are 0.08 SD, of an SD 0.06; its bias 0.01
    assert ((found.mean - exact.mean).abs() / exact.sd).max() < 0.08
    assert (found.sd / exact.sd - 1).abs().max() < 0.07


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_cover_truths_of_the_prior(kind, rotating_seed, draws_factor):
    """800 vehicles of the prior: the 90 % intervals hold 90 %, to 5 binomial errors (0.011) and the sampler's 1 %."""
    count, g = 800 * draws_factor, torch.Generator().manual_seed(rotating_seed)
    truth = vehicles_of(kind, count, g)
    density = density_of(kind, drive(kind, truth, g)[1])
    found = sample(density, SamplerSettings(chains=64, draws=16), generator=g)
    used = found.converged
    assert used.double().mean() > 0.98
    covered = ((found.quantile(0.05) <= truth) & (truth <= found.quantile(0.95)))[used].double().mean(0)
    assert ((covered - 0.9).abs() < BAR * math.sqrt(0.09 / count) + 0.01).all()


@pytest.mark.statistical
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("estimator", ["sgld", "map"])
def test_the_stream_follows_them(kind, estimator, rotating_seed):
    g = torch.Generator().manual_seed(rotating_seed)
    time, columns = drive(kind, TRUTH, g, rows=400)
    options = {"form": FORM[kind](), "actuation_prior": PRIOR[kind](), "estimator": estimator, "vehicles": 2}
    stream = BeliefStream(window=10.0, seed=rotating_seed, **options)
    windows = stream.feed(time, columns) + stream.flush()
    assert len(windows) == 2
    for window in windows:
        belief = window.belief
        assert belief.excited.all()
        assert belief.converged.all()
        assert ((belief.mean - TRUTH).abs() < BAR * belief.sd).all()
    # well below the prior's 0.4 s and 0.3, or 0.6 of damping
    assert (windows[-1].belief.sd[0, :2] < 0.1).all()


@pytest.mark.parametrize("kind", KINDS)
def test_standing_still_teaches_nothing(kind):
    columns = {name: torch.zeros(1, 100, dtype=F64) for name in FORM[kind].columns}
    time = 0.05 * torch.arange(100, dtype=F64)
    stream = BeliefStream(window=5.0, form=FORM[kind](), actuation_prior=PRIOR[kind]())
    (window,) = stream.feed(time, columns) + stream.flush()
    assert not window.belief.excited.any()
