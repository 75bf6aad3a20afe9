"""Posteriors of finds: the exact gradient, SGLD against NUTS and Laplace, names and the repaired simulator."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import (
    EFFECTS,
    AerodynamicDrag,
    CommandHold,
    DeadTime,
    DrivelineOscillation,
    Effect,
    GainChange,
    GapPlant,
    GearShift,
    Gust,
    Outliers,
    RoadGrade,
    SecondOrderActuator,
    SensorBias,
    SensorScale,
    plant,
)
from avtorch.gap.likelihood.noise_segments import CALM
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.posterior.density import RolloutDensity, root
from avtorch.gap.posterior.importance_sampling import effective_sample_size, importance
from avtorch.gap.posterior.sample import (
    exact_one_in,
    fitted,
    lag_and_gain,
    posterior,
    repaired,
    reported,
    reported_draws,
    stein_discrepancy,
)
from avtorch.gap.posterior.surrogate import Corrected
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.inference.density import Density, ScoredDensity, SubsampledDensity
from tests.bars import BAR
from tests.gap.finds import found_of
from tests.gap.records import QUIET

# as the table of effects names them
NAMES = {
    "aerodynamic_drag": {"drag_per_m"},
    "backlash": {"half_width_mps2"},
    "brake_throttle_asymmetry": {"brake_gain_ratio", "brake_lag_ratio"},
    "command_hold": {"hold_fraction"},
    "constant_resistance": {"resistance_mps2"},
    "dead_band": {"half_width_mps2"},
    "dead_time": {"delay_s"},
    "driveline_oscillation": {"frequency_hz", "amplitude"},
    "gain_change": {"gain_ratio", "change_s"},
    "gear_shift": {"depth", "duration_s"},
    "gust": {"sd_mps2", "time_constant_s"},
    "low_speed_creep": {"creep_mps2"},
    "outliers": {"fraction", "scale"},
    "rate_limit": {"jerk_max_mps3"},
    "road_grade": {"grade_rms"},
    "saturation": {"accel_max_mps2", "accel_min_mps2"},
    "second_order_actuator": {"natural_frequency_radps", "damping_ratio"},
    "sensor_bias": {"bias_mps2"},
    "sensor_lag": {"lag_s"},
    "sensor_scale": {"scale"},
    "speed_dependent_gain": {"gain_slope"},
    "speed_dependent_lag": {"lag_slope"},
}


def near(found: FittedModel, count: int, seed: int = 0) -> torch.Tensor:
    """Places (count, 1, coordinate) within the posterior."""
    noise = torch.randn(count, 1, len(found.z), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.as_tensor(found.z) + noise @ root(found.covariance).mT


# the density ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rate_hz", [20, 60])
def test_the_adjoint_is_the_transpose(rate_hz: int) -> None:
    found = found_of([], rate_hz=rate_hz)
    record, noise = found.hypothesis.record, found.noise.noise
    white = WhiteningFilter(record, noise, ((100, noise.replaced(accel_sd=0.1)), (300, noise.replaced(force_sd=0.3))))
    rng = np.random.default_rng(0)
    errors = rng.standard_normal((2, *found.errors.shape))
    images = white(errors)
    back = rng.standard_normal(images.shape)
    np.testing.assert_allclose(
        (images * back).sum((1, 2, 3)), (errors * white.transpose(back)).sum((1, 2, 3)), rtol=1e-9
    )


@pytest.mark.parametrize(
    "effects",
    [[DeadTime(0.163)], [SecondOrderActuator(0.15), AerodynamicDrag()], [RoadGrade(0.03)], [DrivelineOscillation()]],
    ids=lambda e: "+".join(x.name for x in e),
)
@pytest.mark.parametrize("onset", [None, 200])
def test_the_gradient_against_differences(effects: list[Effect], onset: int | None) -> None:
    found = found_of(effects, onset=onset)
    density = RolloutDensity.of(found)
    z = near(found, 2)
    value, score = density.expand(z)
    torch.testing.assert_close(density.value(z), value)
    scale, h = root(found.covariance), 1e-3
    for i in range(z.shape[-1]):
        ahead, behind = density.value(z + h * scale[:, i]), density.value(z - h * scale[:, i])
        torch.testing.assert_close((score @ scale)[..., i], (ahead - behind) / (2 * h), atol=2e-3, rtol=1e-4)


def test_autograd_goes_through_the_density() -> None:
    found = found_of([DeadTime(0.163)], rate_hz=60)
    density = RolloutDensity.of(found)
    assert isinstance(density, Density)
    assert isinstance(density, ScoredDensity)
    z = near(found, 3).requires_grad_()
    (gradient,) = torch.autograd.grad(density.log_prob(z).sum(), z)
    torch.testing.assert_close(gradient, density.score(z.detach()))


@pytest.mark.parametrize("effects", [[DeadTime(0.163)], [RoadGrade(0.03)]], ids=["plain", "slope"])
def test_at_the_mode_it_is_the_fits_own(effects: list[Effect]) -> None:
    found = found_of(effects)
    density = RolloutDensity.of(found)
    # the size of a slope is integrated over a finer grid here
    assert float(density.value(density.initial())) == pytest.approx(found.log_likelihood, abs=5e-3)


def test_values_and_coordinates_go_to_and_fro() -> None:
    found = found_of([DeadTime(0.163), SensorScale(1.1)])
    density = RolloutDensity.of(found)
    z = near(found, 4)
    torch.testing.assert_close(density.unconstrain(density.constrain(z)), z)
    at = density.constrain(density.initial())[0]
    assert dict(zip(density.names, at.tolist(), strict=True)) == pytest.approx(dict(found.values))


def test_far_out_there_is_no_rollout_of_infinities() -> None:
    density = RolloutDensity.of(found_of([DeadTime(0.163)]))
    z = torch.tensor([[[500.0, -500.0, 700.0]], [[math.nan, 0.0, 0.0]]], dtype=torch.float64)
    value, score = density.expand(z)
    assert bool(score[0].isfinite().all())
    assert float(value[0]) < -1e5
    assert bool(value[1].isnan())


def test_before_a_gust_the_force_is_calm() -> None:
    found = found_of([Gust(), DeadTime(0.163)], gust_onset=250, noise=QUIET.replaced(force_sd=0.2))
    density = RolloutDensity.of(found)
    assert density.onset is None  # the dead time was there from the start
    ((row, calm),) = density.white.until
    assert row == 250
    assert calm == found.noise.noise.replaced(force_sd=CALM)
    z, h = near(found, 1), 1e-5
    for i in range(z.shape[-1]):
        step = torch.zeros_like(z)
        step[..., i] = h
        slope = (density.value(z + step) - density.value(z - step)) / (2 * h)
        torch.testing.assert_close(density.score(z)[..., i], slope, rtol=1e-4, atol=1e-3)


# the surrogate --------------------------------------------------------------------------------------------------------
def test_of_a_linear_effect_the_surrogate_is_exact() -> None:
    found = found_of([SensorBias(0.05)])
    density = RolloutDensity.of(found)
    surrogate, mode = fitted(density, found.covariance)
    z = near(found, 8)
    apart = (density.score(z) - surrogate.score(z)) @ root(found.covariance)
    assert float(apart.abs().max()) < 0.05  # T_L is not linear
    torch.testing.assert_close(surrogate.log_prob(z), density.value(z), atol=0.02, rtol=0)
    assert exact_one_in(density, surrogate, mode, torch.Generator().manual_seed(0)) == 16


def test_corrected_gradients_are_unbiased() -> None:
    found = found_of([DrivelineOscillation()])
    density = RolloutDensity.of(found)
    surrogate, mode = fitted(density, found.covariance)
    target = Corrected(density, surrogate, mode, 5)
    assert isinstance(target, SubsampledDensity)
    z = near(found, 6)
    z[0] = mode.z + 9 * mode.scale[0][:, 0]  # far: the exact one at each step
    total = torch.zeros_like(z)
    for k in range(5):
        place = z.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(target.log_prob_minibatch(place, torch.tensor([k])).sum(), place)
        torch.testing.assert_close(gradient[0], density.score(z)[0])
        total += gradient / 5
    torch.testing.assert_close(total, density.score(z), atol=1e-6, rtol=1e-8)


# the draws ------------------------------------------------------------------------------------------------------------
def moments(z: np.ndarray, worth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means and sds of draws (draw, coordinate) with their standard errors, for draws worth so many."""
    mean, sd = z.mean(0), z.std(0)
    fourth = ((z - mean) ** 4).mean(0) / sd**4
    return mean, sd / math.sqrt(worth), sd, sd * np.sqrt((fourth - 1) / (4 * worth))


@pytest.mark.slow
@pytest.mark.statistical
def test_sgld_is_laplaces_where_that_is_right(rotating_seed: int) -> None:
    """A bias of the sensor and the gain are linear; the lag nearly so."""
    found = found_of([SensorBias(0.05)], seconds=60)
    draws = posterior(found, chains=64, seed=rotating_seed)
    assert draws.method == "sgld"
    assert draws.exact_share < 0.1
    assert draws.z.shape == (64, 50, 3)
    z = draws.z.reshape(-1, len(found.z))
    mean, mean_error, sd, sd_error = moments(z, len(z) / 2)
    laplace = np.sqrt(np.diag(found.covariance))
    # a lag's skew moves its mean and sd by a few hundredths of an sd
    assert np.all(np.abs(mean - found.z) < BAR * mean_error + 0.05 * laplace)
    assert np.all(np.abs(sd - laplace) < BAR * sd_error + 0.05 * laplace)


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("effect", [DeadTime(0.163), SecondOrderActuator(0.15)], ids=lambda e: e.name)
def test_sgld_against_nuts(effect: Effect, rotating_seed: int) -> None:
    pytest.importorskip("pyro")
    from avtorch.inference.nuts import nuts

    found = found_of([effect], seconds=20)
    draws = posterior(found, chains=32, seed=rotating_seed)
    assert draws.method == "sgld"
    z = draws.z.reshape(-1, len(found.z))
    mean, mean_error, sd, sd_error = moments(z, len(z) / 2)
    density: Any = RolloutDensity.of(found)
    walked = nuts(density, draws=120, warmup=50, seed=rotating_seed % 2**31)
    reference = walked.draws[0, :, 0].log().numpy()  # NUTS takes every density for one of logarithms
    # autocorrelation: NUTS' draws here are worth a half of their number, or more
    near_mean, near_mean_error, near_sd, near_sd_error = moments(reference, len(reference) / 2)
    assert np.all(np.abs(mean - near_mean) < BAR * np.hypot(mean_error, near_mean_error) + 0.05 * sd)
    assert np.all(np.abs(sd - near_sd) < BAR * np.hypot(sd_error, near_sd_error) + 0.05 * sd)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_draws() -> None:
    found = found_of([DeadTime(0.163)])
    one, two, other = (posterior(found, draws=10, seed=s).z for s in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert np.abs(one - other).max() > 0


def test_where_gradients_lead_nowhere_places_are_weighed() -> None:
    found = found_of([GearShift(first_mps=7.0)])
    draws = posterior(found)
    assert draws.method in ("importance", "laplace")
    assert draws.why
    assert draws.z.shape[:2] == (16, 50)
    assert np.isfinite(draws.z).all()
    assert (draws.method == "importance") == (draws.effective >= 30)


def test_draws_that_are_too_wide_are_noticed() -> None:
    found = found_of([DeadTime(0.163)], seconds=60)
    density = RolloutDensity.of(found)
    _, mode = fitted(density, found.covariance)
    noise = torch.randn(16, 50, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn_right = mode.z[0] + noise @ mode.scale[0].mT
    assert stein_discrepancy(density, mode, drawn_right, torch.Generator().manual_seed(0)) == 0
    too_wide = mode.z[0] + 1.6 * noise @ mode.scale[0].mT
    assert stein_discrepancy(density, mode, too_wide, torch.Generator().manual_seed(0)) > 0.5


@pytest.mark.statistical
def test_importance_on_a_cliff(rotating_seed: int) -> None:
    """A normal cut off at its centre: mean sqrt(2/pi), variance 1 - 2/pi, times a normal five times as wide."""

    def log_prob(z: np.ndarray) -> np.ndarray:
        return np.where(z[:, 0] > 0, -0.5 * z[:, 0] ** 2, -np.inf) - 0.5 * (z[:, 1] / 5) ** 2

    places, weights = importance(log_prob, np.zeros(2), np.eye(2), rounds=5, size=400, enough=1e9, seed=rotating_seed)
    worth = effective_sample_size(weights)
    assert worth > 300
    assert weights.sum() == pytest.approx(1)
    mean = weights @ places
    sd = np.sqrt(weights @ (places - mean) ** 2)
    exact = np.sqrt([1 - 2 / math.pi, 25.0])
    # weights do not spread as draws do: six standard errors of as many draws as they are worth
    assert np.all(np.abs(mean - [math.sqrt(2 / math.pi), 0]) < 6 * exact / math.sqrt(worth))
    assert np.all(np.abs(sd - exact) < 6 * exact / math.sqrt(worth))


def test_too_few_draws_are_refused() -> None:
    with pytest.raises(InputError, match="draws"):
        posterior(found_of([]), draws=2)


# in the answer's names ------------------------------------------------------------------------------------------------
def test_the_table_is_complete() -> None:
    assert set(NAMES) <= set(EFFECTS)


@pytest.mark.parametrize("name", sorted(NAMES))
def test_reported_and_repaired(name: str) -> None:
    # the change lies within the drive
    found = found_of([GainChange(change_s=14.0, ramp_s=2.0) if name == "gain_change" else EFFECTS[name]()], rounds=1)
    told = reported(found)
    assert set(told) == NAMES[name]
    assert all(q.sd > 0 for q in told.values())
    assert set(lag_and_gain(found)) == {"T_L", "K_L"}
    car = repaired(found)
    assert [e.name for e in car.effects] == [name]
    again = GapPlant.from_toml(car.to_toml())
    assert again.to_toml() == car.to_toml()
    noise = found.noise.noise
    assert car.sigma == pytest.approx(noise.process_sd * math.sqrt(2 / noise.process_time))


def test_truth_is_within_what_is_reported() -> None:
    found = found_of([SecondOrderActuator(0.15)], seconds=60)
    for draws in (None, posterior(found, draws=20)):
        told = reported(found, draws) | lag_and_gain(found, draws)
        truth = {"natural_frequency_radps": 1 / 0.15, "damping_ratio": 0.35 / 0.3, "T_L": 0.35, "K_L": 0.95}
        for key, value in truth.items():
            assert abs(told[key].mean - value) < 5 * told[key].sd


def test_pairs_have_their_effects_in_front() -> None:
    found = found_of([DrivelineOscillation(), Outliers()])
    draws = posterior(found, draws=10)
    keys = {
        "driveline_oscillation.frequency_hz",
        "driveline_oscillation.amplitude",
        "outliers.fraction",
        "outliers.scale",
    }
    assert set(reported(found)) == set(reported(found, draws)) == keys
    each = reported_draws(found, draws)
    assert list(each)[:2] == ["T_L", "K_L"]
    assert set(each) == {"T_L", "K_L", *keys}
    assert {x.shape for x in each.values()} == {(16, 10)}
    hypot = np.hypot(*(draws.values[f"driveline_oscillation.{k}"] for k in ("amplitude", "quadrature")))
    np.testing.assert_allclose(each["driveline_oscillation.amplitude"], hypot)
    assert [e.name for e in repaired(found, None, draws).effects] == ["driveline_oscillation", "outliers"]


def test_lost_messages_and_gusts_match_their_fits() -> None:
    held = reported(found_of([CommandHold()], rounds=1))["hold_fraction"]
    assert held.q05 < 0.1 < held.q95
    found = found_of([Gust()], rounds=1)
    gust = reported(found)["sd_mps2"]
    assert gust.q05 < found.noise.noise.force_sd < gust.q95


def test_a_slope_found_goes_into_the_simulator() -> None:
    found = found_of([RoadGrade(0.04)], seconds=60)
    draws = posterior(found, draws=10)
    assert draws.grade_rms is not None
    assert draws.grade_rms.shape == (16, 10)
    for given in (None, draws):
        road = repaired(found, draws=given).effects[0]
        assert isinstance(road, RoadGrade)
        assert road.profile is not None
        assert found.profile is not None
        np.testing.assert_allclose(float(road.grade_rms) * road.profile.numpy(), found.profile)


def test_the_baselines_effects_stay() -> None:
    baseline = plant([DeadTime(0.2)])
    found = found_of([SensorScale(1.1)], baseline=baseline, rounds=1)
    assert [e.name for e in repaired(found).effects] == ["dead_time", "sensor_scale"]
    assert [e.name for e in repaired(found, plant()).effects] == ["sensor_scale"]
    assert set(reported(found)) == {"scale"}


def test_a_covariance_without_a_root_gets_one() -> None:
    lower = root(np.array([[1.0, 1.0], [1.0, 1.0 - 1e-12]]))
    torch.testing.assert_close(lower @ lower.mT, torch.ones(2, 2, dtype=torch.float64), atol=1e-6, rtol=0)
    found = found_of([], rounds=1)
    shrunk = replace(found, covariance=0.01 * found.covariance)
    assert np.isfinite(posterior(shrunk, draws=8).z).all()
