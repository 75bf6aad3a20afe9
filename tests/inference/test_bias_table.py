"""The instruments of the bias table: its closed forms, its effective sample size, its rows."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from avtorch.inference.coordinates import Coordinates
from benchmarks.bias.arms import Arm, Length, every_arm, predict, run, settings
from benchmarks.bias.law import point_covariance, sd_ratio
from benchmarks.bias.measure import autocorrelation_time, measure
from benchmarks.bias.windows import Problem, problem
from tests.bars import BAR

F64 = torch.float64


@pytest.fixture(scope="module")
def one() -> Problem:
    """Three windows of one vehicle, weak to strong."""
    return problem(200, vehicles=1)


@pytest.mark.parametrize("h", [0.1, 0.8, 2.0])
@pytest.mark.parametrize("s2", [0.0, 5.0])
def test_the_closed_form_is_the_whitened_one(one, h, s2):
    """``(1 + h s2/4) / (1 - h/4)`` and ``1 + (h s2/4) / (1 - h/4)``; with growing noise s2 multiplies the variance."""
    covariance = s2 * torch.linalg.inv(one.mode.covariance) if s2 else None
    coordinates = Coordinates.of(one.mode)
    expected = {
        (False, False): (1 + h * s2 / 4) / (1 - h / 4),
        (True, False): 1 + h * s2 / 4 / (1 - h / 4),
        (False, True): 1 / (1 - h / 4 * (1 + s2)) if h / 4 * (1 + s2) < 1 else math.inf,
    }
    for (averaged, grows), variance in expected.items():
        found = sd_ratio(one, coordinates, h, covariance, averaged=averaged, grows=grows)
        torch.testing.assert_close(found, torch.full_like(found, math.sqrt(variance)), rtol=1e-6, atol=0)


def test_other_coordinates_have_another_bias(one):
    """Isotropic: a direction ``sd`` wide, the narrowest ``least``: ``1/(1 - h least^2/(4 sd^2))``; 4 is unstable."""
    coordinates = Coordinates.of(one.mode, "none")
    found = sd_ratio(one, coordinates, 1.0, None, averaged=False, grows=False)
    values, basis = torch.linalg.eigh(one.mode.covariance)
    spread = values / (1 - values[:, :1] / (4 * values))
    variance = torch.einsum("wij,wj,wij->wi", basis, spread, basis)
    expected = (variance / one.mode.covariance.diagonal(dim1=-2, dim2=-1)).sqrt()
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    assert sd_ratio(one, coordinates, 4.0, None, averaged=False, grows=False).isinf().all()


def test_a_points_gradient_has_the_variance_of_fisher(one):
    """Whitened, a single of N points has about variance N in each direction; control variates leave far less."""
    scale = one.mode.scale
    plain = scale.mT @ point_covariance(one, control_variates=False) @ scale
    steady = scale.mT @ point_covariance(one, control_variates=True) @ scale
    per_point = plain.diagonal(dim1=-2, dim2=-1) / one.points
    # where the points outweigh the prior
    assert ((per_point > 0.5) & (per_point < 2))[one.strength > 0].all()
    left = steady.diagonal(dim1=-2, dim2=-1) / plain.diagonal(dim1=-2, dim2=-1)
    assert (left < 0.1)[one.strength > 0].all()


@pytest.mark.statistical
def test_autocorrelation_time_of_an_autoregression(rotating_seed):
    """(1 + r)/(1 - r), also below one where steps alternate."""
    g = torch.Generator().manual_seed(rotating_seed)
    for r in (0.9, 0.0, -0.5):
        x = [torch.randn(200, generator=g, dtype=F64)]
        for _ in range(999):
            x.append(r * x[-1] + math.sqrt(1 - r * r) * torch.randn(200, generator=g, dtype=F64))
        # 10 000 effective draws and more: the time itself is good to some 3 %
        found = autocorrelation_time(torch.stack(x, 1)[..., None]).item()
        assert found == pytest.approx((1 + r) / (1 - r), rel=0.2)


@pytest.mark.statistical
def test_the_closed_form_is_what_a_walk_does(one, rotating_seed, draws_factor):
    """Strong excitation, step 1.5: independent noise widens as predicted, averaged does not."""
    size = Length(chains=256 * draws_factor, burn_in=30, steps=200)
    for noise in ("independent", "averaged"):
        arm = Arm("", 1.5, noise=noise)
        found = measure(one, run(arm, one, size, seed=rotating_seed))
        told = predict(arm, one, {})
        assert told is not None
        assert not found.lost.any()
        gap = found.sd_ratio - told.gather(-1, found.parameter[:, None]).squeeze(-1)
        # 20 000 effective draws; 200 points leave the posterior a per cent or two off Gaussian
        assert gap[one.strength == 2].abs().item() < BAR * found.sd_error[2].item() + 0.02
        assert found.ess_per_step[2] > 0.2


def test_a_lost_window_is_counted_and_not_averaged(one):
    z = one.mode.z + torch.zeros(4, 40, *one.mode.z.shape, dtype=F64)
    z[1, 5, 0, 0] = math.nan
    z[2, 7, 1] += 1e3 * one.mode.scale[1, :, 0]
    found = measure(one, z)
    assert found.lost.tolist() == [True, True, False]
    assert found.sd_ratio.isnan().tolist() == [True, True, False]


def test_every_row_can_be_walked(one):
    arms = every_arm()
    assert len(set(arms)) == len(arms)
    for arm in arms:
        size = Length(chains=2, burn_in=1, steps=40)
        assert settings(arm, size).draws == 41
    for arm in (next(a for a in arms if a.cv), *(a for a in arms if a.whitening == "rmsprop")):
        z = run(replace(arm, batch=None if arm.batch is None else 5), one, Length(2, 1, 4))
        assert z.shape == (2, 4, 3, 3)
