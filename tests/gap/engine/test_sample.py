"""Draws of a hypothesis's coordinates: Laplace's and SGLD's against each other, NUTS, the truth, halves of a drive."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy import stats

from avtorch.gap import Backlash, DeadTime, SecondOrderActuator, SensorBias, SensorScale, SpeedDependentGain
from avtorch.gap.engine.density import HypothesisDensity
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.sample import (
    Laplace,
    corrected,
    fitted,
    reflected,
    sample,
    stein_discrepancy,
    truncated_normal,
)
from avtorch.gap.engine.surrogate import Corrected
from avtorch.inference.density import SubsampledDensity
from avtorch.inference.priors import LogSpaceNormal
from tests.bars import BAR
from tests.gap.engine.recorded import FILTER, GAIN, LAG, LATE, fitted_hypothesis, recorded_log

CARS = {
    "sensor_bias": (SensorBias(0.1), (0.1,), 0.1),
    "dead_time": (DeadTime(0.2), (0.18,), 0.2),
    "second_order_actuator": (SecondOrderActuator(0.15), (0.02,), 0.15**2),
    "speed_dependent_gain": (SpeedDependentGain(0.3, 10.0), (0.25,), None),
    "backlash": (Backlash(0.1), (0.09,), 0.1),
    "sensor_scale": (SensorScale(1.1), (0.1,), 0.1),
}


@lru_cache
def a_fit(effect: str, seconds: float = 40.0, seed: int = 0, drift: float = 0.0) -> Hypothesis:
    car, start, _ = CARS[effect]
    return fitted_hypothesis(recorded_log([car], seconds=seconds, seed=seed, drift=drift), effect, start)


def parts_of(h: Hypothesis, temper: float = 0.25, seed: int = 0):
    """Density, surrogate, mode and generator as `sample` has them."""
    normal = Laplace.of(h, temper=temper)
    density = HypothesisDensity(h, temper, normal.names, np.sqrt(np.diag(normal.covariance)))
    generator = torch.Generator().manual_seed(seed)
    surrogate, mode = fitted(density, normal, generator)
    return density, surrogate, mode, generator


# Laplace's draws ------------------------------------------------------------------------------------------------------
@pytest.mark.statistical
@pytest.mark.parametrize("centre", [0.5, -6.0], ids=["inside", "far outside"])
def test_a_normal_within_limits(centre, rotating_seed):
    """One coordinate has limits, the other goes with it."""
    covariance = np.array([[1.0, 0.6], [0.6, 1.0]])
    limits = np.array([[0.0, 2.0], [-np.inf, np.inf]])
    x = truncated_normal(np.array([centre, 0.0]), covariance, limits, 4000, np.random.default_rng(rotating_seed))
    assert x[:, 0].min() >= 0
    assert x[:, 0].max() <= 2
    exact = stats.truncnorm(-centre, 2 - centre, centre, 1)
    error = 1.5 * exact.std() / math.sqrt(len(x))  # Gibbs' draws come from 4000 chains, but of 50 sweeps
    assert abs(x[:, 0].mean() - exact.mean()) < BAR * error
    assert abs(x[:, 1].mean() - 0.6 * (exact.mean() - centre)) < BAR * 1.5 / math.sqrt(len(x))


def test_reflected_within_limits():
    limits = np.array([[0.0, 1.0], [-np.inf, np.inf]])
    x = np.array([[-0.2, 5.0], [1.3, -7.0], [2.4, 0.0], [0.6, 1.0]])
    np.testing.assert_allclose(reflected(x, limits), [[0.2, 5.0], [0.7, -7.0], [0.4, 0.0], [0.6, 1.0]])


def test_laplaces_draws_are_as_wide_as_its_covariance():
    h = a_fit("sensor_bias")
    normal = Laplace.of(h)
    x = normal.draws(20_000, np.random.default_rng(0), widen=False)
    k = normal.names.index("sensor_bias")
    assert x[:, k].std() == pytest.approx(math.sqrt(normal.covariance[k, k]), rel=0.03)
    assert x[:, normal.names.index("accel_filter")].min() >= 0


def test_intervals_cover_what_halves_disagree_on():
    """The gain grows by 15 % at half time, which the hypothesis does not know."""
    h = a_fit("sensor_bias", 120.0, drift=0.15)
    normal = Laplace.of(h)
    k, half = normal.names.index("K_L"), h.data.frame_count // 2
    sd, plain = math.sqrt(normal.widened[k, k]), math.sqrt(normal.covariance[k, k])
    for frames in (np.arange(h.data.frame_count) < half, np.arange(h.data.frame_count) >= half):
        alone = fit(h.on(h.data.only(frames)), 8)
        assert abs(alone["K_L"] - h["K_L"]) > 2 * plain
        assert abs(alone["K_L"] - h["K_L"]) < 1.65 * sd
    draws = sample(h, chains=1, draws=4000, method="laplace")
    assert draws["K_L"].std() == pytest.approx(sd, rel=0.1)
    assert sd > 2 * plain


def test_a_car_that_stays_the_same_is_not_widened():
    normal = Laplace.of(a_fit("sensor_bias", 120.0))
    assert np.all(np.diag(normal.widened) < 1.5**2 * np.diag(normal.covariance))


def test_a_limit_out_of_reach_stays():
    h = fitted_hypothesis(recorded_log(), "saturation", (0.0, 0.0))
    assert h["drive_limit"] == h["brake_limit"] == 0
    draws = sample(h, chains=4, draws=8, method="laplace")
    assert draws.names == tuple(h.free)
    assert not draws["brake_limit"].any()
    assert draws["K_L"].std() > 0


# the surrogate --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("effect", ["sensor_bias", "second_order_actuator"])
def test_the_surrogate_is_near_the_density(effect):
    density, surrogate, mode, generator = parts_of(a_fit(effect))
    z = mode.z + torch.randn(40, 1, len(density.names), dtype=torch.float64, generator=generator) @ mode.scale[0].mT
    apart = density.value(z) - surrogate.value(z)
    assert float((apart - apart.median()).abs().median()) < 0.1
    moved = z[:2].clone().requires_grad_()
    (gradient,) = torch.autograd.grad(surrogate.log_prob(moved).sum(), moved)
    for k in range(z.shape[-1]):
        step = torch.zeros_like(z[:2])
        step[..., k] = 1e-5 * float(mode.scale[0].diagonal()[k].abs())
        slope = (surrogate.value(z[:2] + step) - surrogate.value(z[:2] - step)) / (2 * step[..., k])
        torch.testing.assert_close(gradient[..., k], slope, rtol=1e-4, atol=1e-3)


def test_corrected_gradients_are_unbiased():
    density, surrogate, _, generator = parts_of(a_fit("dead_time"))
    target = Corrected(density, surrogate, 5, reach=4.0)
    assert isinstance(target, SubsampledDensity)
    z = surrogate.middle + torch.randn(6, 1, len(density.names), dtype=torch.float64, generator=generator) @ (
        surrogate.spread.mT
    )
    z[0] = surrogate.middle + 9 * surrogate.spread[:, 0]  # far: the exact one at each step
    total = torch.zeros_like(z)
    for k in range(5):
        place = z.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(target.log_prob_minibatch(place, torch.tensor([k])).sum(), place)
        torch.testing.assert_close(gradient[0], density.score(z)[0])
        total += gradient / 5
    torch.testing.assert_close(total, density.score(z), atol=1e-6, rtol=1e-8)


# SGLD -----------------------------------------------------------------------------------------------------------------
def moments(x: np.ndarray, worth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means and sds of draws (draw, coordinate) with their standard errors, for draws worth so many."""
    mean, sd = x.mean(0), x.std(0)
    fourth = ((x - mean) ** 4).mean(0) / sd**4
    return mean, sd / math.sqrt(worth), sd, sd * np.sqrt((fourth - 1) / (4 * worth))


@pytest.mark.slow
@pytest.mark.statistical
def test_sgld_is_laplaces_where_that_is_right(rotating_seed):
    """A long drive, not tempered: only the recorder's filters feel their limits."""
    h = a_fit("sensor_bias", 300.0)
    draws = sample(h, chains=32, seed=rotating_seed % 2**31, temper=1.0, widen=False)
    assert draws.method == "sgld"
    assert draws.x.shape == (32, 50, len(h.free))
    mean, mean_error, sd, sd_error = moments(draws.x.reshape(-1, len(h.free)), draws.effective)
    normal = Laplace.of(h, temper=1.0)
    for k, name in enumerate(h.free):
        if name in ("T_L", "K_L", "sensor_bias"):
            laplace = math.sqrt(normal.covariance[k, k])
            assert abs(mean[k] - normal.mean[k]) < BAR * mean_error[k] + 0.2 * laplace
            assert abs(sd[k] - laplace) < BAR * sd_error[k] + 0.15 * laplace


class _Prior(HypothesisDensity):
    """With a prior that `nuts` asks for and does not use."""

    @property
    def prior(self) -> LogSpaceNormal:
        size = len(self.names)
        return LogSpaceNormal(torch.zeros(1, size, dtype=torch.float64), torch.eye(size, dtype=torch.float64)[None])

    def select(self, index):
        return self


@pytest.mark.slow
@pytest.mark.statistical
def test_sgld_against_nuts(rotating_seed):
    """One of three effects a run: NUTS takes minutes."""
    pytest.importorskip("pyro")
    from avtorch.inference.nuts import nuts

    effect = ("second_order_actuator", "speed_dependent_gain", "sensor_scale")[rotating_seed % 3]
    h = a_fit(effect, 80.0)
    draws = sample(h, chains=32, seed=rotating_seed % 2**31, widen=False)
    assert draws.method == "sgld"
    mean, mean_error, sd, sd_error = moments(draws.x.reshape(-1, len(h.free)), draws.effective)
    normal = Laplace.of(h)
    density = _Prior(h, knee=np.sqrt(np.diag(normal.covariance)))
    walked = nuts(density, draws=250, warmup=150, seed=rotating_seed % 2**31)
    z = walked.draws[0, :, 0].log()  # NUTS takes every density for one of logarithms
    reference = density.constrain(z).numpy()
    # autocorrelation: NUTS' draws here are worth a third of their number, or more
    near_mean, near_mean_error, near_sd, near_sd_error = moments(reference, len(reference) / 3)
    assert np.all(np.abs(mean - near_mean) < BAR * np.hypot(mean_error, near_mean_error) + 0.05 * sd)
    assert np.all(np.abs(sd - near_sd) < BAR * np.hypot(sd_error, near_sd_error) + 0.1 * sd)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws():
    h = a_fit("sensor_scale", 80.0)
    one, two, other = (sample(h, chains=8, draws=10, seed=s) for s in (3, 3, 4))
    assert one.method == two.method
    np.testing.assert_array_equal(one.x, two.x)
    assert np.abs(one.x - other.x).max() > 0


def test_the_same_seed_gives_the_same_normal_draws():
    h = a_fit("dead_time")
    one, two = (sample(h, draws=10, seed=3, method="laplace").x for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["sgld", "laplace"])
@pytest.mark.parametrize("effect", ["sensor_bias", "dead_time", "second_order_actuator", "backlash", "sensor_scale"])
def test_the_truth_is_within_what_is_drawn(effect, method):
    h = a_fit(effect, 80.0)
    draws = sample(h, method=method)
    assert draws.method in (method, "importance")
    assert draws.effective > 30
    truth = {"T_L": LAG, "K_L": GAIN, h.free[-1]: CARS[effect][2]}
    truth |= {f"{c}_filter": FILTER[c] for c in FILTER} | {f"{c}_delay": LATE[c] for c in LATE}
    for name, value in truth.items():
        assert abs(draws[name].mean() - value) < 4 * draws[name].std(), name


def test_draws_that_are_too_wide_are_noticed():
    # long enough for a recorder's filter to be far from 0, where its posterior is not normal
    density, _, mode, generator = parts_of(a_fit("sensor_bias", 300.0), temper=1.0)
    noise = torch.randn(16, 50, len(density.names), dtype=torch.float64, generator=generator)
    drawn_right = mode.z[0] + noise @ mode.scale[0].mT
    assert stein_discrepancy(density, mode, drawn_right, generator) < 0.3
    too_wide = mode.z[0] + 1.8 * noise @ mode.scale[0].mT
    assert stein_discrepancy(density, mode, too_wide, generator) > 0.5


# where it does not go -------------------------------------------------------------------------------------------------
def test_without_a_gradient_draws_are_laplaces_and_say_why():
    h = a_fit("second_order_actuator").with_effect("rate_limit", (0.3, 0.0), 20.0).evaluate()
    draws = sample(h, chains=4, draws=8)
    assert draws.method == "laplace"
    assert "rate_limit" in draws.why
    assert draws.x.shape == (4, 8, len(h.free))


def test_a_surrogate_that_is_far_off_has_no_gradients():
    density, surrogate, mode, generator = parts_of(a_fit("sensor_bias"))
    off = type(surrogate)(density, surrogate.centre + 40 * surrogate.scale.sum(1), *list(vars(surrogate).values())[2:])
    assert corrected(density, off, mode, 1.0, generator) is None
