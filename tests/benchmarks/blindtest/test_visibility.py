"""Visibility: rollout error over noise."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.blindtest.car import Car
from benchmarks.blindtest.drives import DrivePlan
from benchmarks.blindtest.strength import excess_range, solve_strength
from benchmarks.blindtest.vehicle import simulate
from benchmarks.blindtest.visibility import TIERS, exact_gain, oracles, sight, tier_of

CAR = Car(T_L=0.4, K_L=0.9, process_sd=0.05, accel_sd=0.08, speed_sd=0.02)


def run(effects=None, manoeuvre="steps", seconds=60.0):
    made = DrivePlan(manoeuvre, seconds, 50, 3)
    return simulate(CAR, made.pilot(), seconds=seconds, rate_hz=50, effects=effects, seed=2)


def test_a_car_without_a_cause_shows_nothing_and_is_refitted_to_itself() -> None:
    for manoeuvre in ("cruise", "stop_and_go"):
        seen = sight(run(manoeuvre=manoeuvre))
        assert seen.most == pytest.approx(1.0, abs=1e-4)
        assert pytest.approx(0.4, rel=2e-3) == seen.T_L
        assert pytest.approx(0.9, rel=1e-3) == seen.K_L


def test_bias_shows_by_its_size_over_the_noise() -> None:
    made = run({"sensor_bias": {"bias_mps2": 0.15}})
    seen = sight(made)
    noise = np.sqrt(np.mean(made.noise_accel[made.true_speed >= 0.3] ** 2))
    assert seen.accel == pytest.approx(np.hypot(1, 0.15 / noise), rel=0.02)
    assert seen.speed < 1.2


def test_what_refitting_explains_is_no_gap() -> None:
    # a brake and an engine that are both weaker are a car of another gain
    seen = sight(run({"gain_change": {"gain_ratio": 0.7, "change_s": 0.0, "takes_s": 1e-3}}))
    assert seen.most < 1.01
    assert pytest.approx(0.63, rel=0.01) == seen.K_L


def test_exact_gain_integrates_glvd() -> None:
    u = np.random.default_rng(0).normal(size=400)
    a, v = exact_gain(u, 0.02, 0.4)
    fine, _ = exact_gain(np.repeat(u, 200), 1e-4, 0.4)
    speed = np.concatenate([[0.0], np.cumsum(0.5e-4 * (fine[1:] + fine[:-1]))])
    np.testing.assert_allclose(a, fine[::200], atol=1e-12)
    np.testing.assert_allclose(v, speed[::200], atol=1e-7)


def test_oracle_closes_the_gap_and_needs_one() -> None:
    made = run({"sensor_bias": {"bias_mps2": 0.3}})
    assert oracles(made, sight(made), predictable=True)["rollout_rmse_accel"].closed == pytest.approx(1.0)
    assert oracles(made, sight(made), predictable=False)["rollout_rmse_accel"].closed is None
    plain = run()
    assert oracles(plain, sight(plain), predictable=True)["rollout_rmse_speed"].closed is None


def test_tiers() -> None:
    assert [tier_of(v) for v in (1.0, 1.02, 1.15, 1.6, 3.0, 99.0)] == [None, "faint", "hard", "medium", "easy", "easy"]
    for tier in TIERS:
        low, high = excess_range(tier)
        assert tier_of(np.hypot(1, low) + 1e-9) == tier
        assert tier_of(np.hypot(1, high) - 1e-9) == tier


@pytest.mark.parametrize("power", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("tier", TIERS)
def test_strength_is_found_in_few_trials(power: float, tier: str) -> None:
    low, high = excess_range(tier)
    trials: list[float] = []

    def trial(strength: float) -> tuple[float, float]:
        trials.append(strength)
        return 2 * strength**power, strength

    found = solve_strength(trial, (low * high) ** 0.5, low, high, begin=1.0, strongest=1e3)
    assert found is not None
    assert low <= 2 * found**power < high
    assert solve_strength(trial, 1.0, 0.9, 1.1, begin=1.0, strongest=1e-3) is None


def test_only_what_is_logged_is_seen() -> None:
    made = run({"sensor_bias": {"bias_mps2": 0.3}})
    assert sight(made, ["speed"]).most == pytest.approx(1.0, abs=1e-3)
    assert pytest.approx(0.9, rel=1e-3) == sight(made, ["speed"]).K_L
    assert sight(made, ["accel"]).most == pytest.approx(sight(made).most, rel=0.05)
    assert sight(made, ["accel"]).speed == 1.0
