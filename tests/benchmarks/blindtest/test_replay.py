"""An oracle of a drive: driven again with some of its causes, how visible they are, what each takes off the gap."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from avtorch.io import Log
from benchmarks.blindtest import CALIBRATION, EFFECTS, SEALED, Car, DrivePlan, Recorded, Recorder, family, simulate
from benchmarks.blindtest.oracle_budget import gap_over_floor, oracle_budget
from benchmarks.blindtest.replay import Replay
from benchmarks.blindtest.several import excess_range, solve_strength
from benchmarks.blindtest.vehicle import Run
from benchmarks.blindtest.visibility import TIERS, exact_gain, oracles, sight, tier_of

FORETOLD = [name for name in (*EFFECTS, *CALIBRATION, *SEALED) if not family(name).by_chance]


def driven(names: list[str], seed: int, car: Car, *, strength: float = 2.0, onset: float = 8.0) -> Replay:
    manoeuvre = next((family(name).suits[0] for name in names if family(name).suits), "following")
    drive = DrivePlan(manoeuvre, 30.0, 50, seed)
    rng = np.random.default_rng(seed)
    effects = {name: family(name).draw(rng, car, drive)(strength) for name in names}
    begin = 0.0 if "gain_change" in names else onset
    run = simulate(car, drive.pilot(), seconds=30.0, rate_hz=50, effects=effects, onset=begin, seed=seed)
    return Replay(run, car, effects, begin, seed)


def off(replay: Replay, names: list[str]) -> tuple[float, float]:
    """RMS of the difference in acceleration and in the change of speed, over moving rows.

    Each stretch begins anew: where a car comes to rest within a row, up to a row of the acceleration is missed,
    and that stays in the speed.
    """
    run, response = replay.run, replay.response(names)
    moving = run.true_speed > 0.3
    stretch = np.cumsum(np.diff(moving, prepend=False))[moving]
    speed = (response.speed - run.speed)[moving]
    speed = speed - (np.bincount(stretch, speed) / np.maximum(np.bincount(stretch), 1))[stretch]
    return float(np.sqrt(np.mean((response.accel - run.accel)[moving] ** 2))), float(speed.std())


@pytest.mark.slow
@pytest.mark.parametrize("name", FORETOLD)
def test_with_its_cause_it_is_the_drive(name: str, fresh_seed: int) -> None:
    replay = driven([name], fresh_seed, Car(T_L=0.4).silent())
    accel, speed = off(replay, [name])
    without = off(replay, [])
    # speed and place are known at rows, and run straight between them
    assert accel < 2e-3 + 0.02 * without[0]
    assert speed < 2e-3 + 0.02 * without[1]


def test_without_causes_it_is_the_bare_car(fresh_seed: int) -> None:
    replay = driven(["dead_band", "road_grade", "sensor_lag"], fresh_seed, Car().silent())
    bare = Replay(replay.run, replay.car, {})
    np.testing.assert_array_equal(replay.response([]).accel, bare.response([]).accel)
    accel, speed = off(replay, ["sensor_lag", "dead_band", "road_grade"])
    assert (accel, speed) < (5e-3, 5e-3)
    for name in replay.effects:
        rest = [other for other in replay.effects if other != name]
        assert off(replay, rest) > (accel, speed)
    # a slower car with a stronger engine, as a fit may try it
    slow = replay.response(["dead_band"], T_L=0.8, K_L=1.2).accel
    assert np.std(slow) != pytest.approx(np.std(replay.response(["dead_band"]).accel), rel=1e-3)


def test_noise_gusts_and_glitches_stay_outside(fresh_seed: int) -> None:
    replay = driven(["constant_resistance", "gust", "outliers"], fresh_seed, Car(), strength=1.0)
    run: Run = replay.run
    moving = run.true_speed > 0.3
    rest = (run.accel - replay.response(["constant_resistance"]).accel)[moving]
    noise = (run.noise_accel + run.chance_accel)[moving]
    # standstill ends the drive of noise for as long as it lasts, so a few rows differ after one
    assert np.median(np.abs(rest - noise)) < 1e-3


# The oracle's budget, where its shares follow from a sum of squares.
QUIET = Car(T_L=0.3, K_L=1.0, process_sd=0.0, accel_sd=0.03, speed_sd=0.01)
BIAS, HUM = 0.3, 0.2
BIAS_AND_HUM: dict[str, dict[str, float]] = {
    "sensor_bias": {"bias_mps2": BIAS},
    "vibration_aliasing": {"amplitude_mps2": HUM, "turns_per_m": 2.0, "idle_hz": 17.0},
}


def case(effects: dict[str, dict[str, float]], seed: int, *, car: Car = QUIET, seconds: float = 60.0) -> Replay:
    drive = DrivePlan("steps", seconds, 50, seed)
    run = simulate(car, drive.pilot(), seconds=seconds, rate_hz=50, effects=effects, seed=seed)
    return Replay(run, car, effects, 0.0, seed)


def log(replay: Replay, *channels: str) -> Log:
    run = replay.run
    kept: dict[str, Any] = {name: getattr(run, name) for name in channels or ("accel", "speed")}
    return Log.from_arrays(time=run.time, accel_cmd=run.command, **kept)


def test_an_offset_and_a_hum_share_by_their_squares(fresh_seed: int) -> None:
    """An offset of 0.3 has the square 0.09, a hum of amplitude 0.2 the mean square 0.02: 82 and 18 % of the gap.

    Commands of whole periods without a mean: no lag or gain can take the offset's place.
    """
    time = np.arange(3100) / 50
    command = np.sin(2 * np.pi * time / 5) + 0.5 * np.sin(2 * np.pi * time / 2)
    pilot = Recorded(command, start_speed=20.0)
    run = simulate(QUIET, pilot, seconds=62.0, rate_hz=50, effects=BIAS_AND_HUM, seed=fresh_seed)
    replay = Replay(run, QUIET, BIAS_AND_HUM, 0.0, fresh_seed)
    budget = oracle_budget(replay, log(replay, "accel"))
    whole = BIAS**2 + HUM**2 / 2
    # 3000 rows: noise of 0.03 moves a mean square of 0.09 by some 0.4 %, the hum's own by 1 % of it
    assert budget.shares["sensor_bias"] == pytest.approx(BIAS**2 / whole, abs=0.01)
    assert budget.unexplained == pytest.approx(HUM**2 / 2 / whole, abs=0.01)
    assert sum(budget.shares.values()) + budget.unexplained == pytest.approx(1.0, abs=1e-12)
    before, floor = budget.by_channel["accel"]
    # a standard deviation from 3000 rows is 1.3 % off; six times that
    assert floor == pytest.approx(QUIET.accel_sd, rel=0.08)
    assert before == pytest.approx(np.sqrt(whole + QUIET.accel_sd**2), rel=0.02)
    assert budget.before == pytest.approx(before / floor)
    # an accelerometer's faults are none of the speed's
    assert oracle_budget(replay, log(replay, "speed")).before == pytest.approx(1.0, abs=0.01)


def test_the_largest_enters_first_and_chance_takes_nothing(fresh_seed: int) -> None:
    effects = {
        "sensor_bias": {"bias_mps2": 0.05},
        "constant_resistance": {"resistance_mps2": 0.3},
        "outliers": {"fraction": 0.02, "scale": 8.0},
    }
    replay = case(effects, fresh_seed)
    budget = oracle_budget(replay, log(replay))
    assert list(budget.shares) == ["constant_resistance", "sensor_bias"]
    assert budget.chance == ("outliers",)
    assert budget.unexplained == 0.0
    assert budget.before > budget.after["constant_resistance"] > budget.after["sensor_bias"] == pytest.approx(1.0)
    told = budget.to_dict()
    assert [part["names"] for part in told["parts"]] == [["constant_resistance"], ["sensor_bias"]]
    json.dumps(told, allow_nan=False)


def test_lag_and_gain_are_fitted_anew_without_a_cause(fresh_seed: int) -> None:
    """A dead time alone: without it a slower car comes closer than the true lag does."""
    replay = case({"dead_time": {"delay_s": 0.3}}, fresh_seed)
    seen = log(replay)
    fitted = oracle_budget(replay, seen).before
    true = gap_over_floor(replay, seen, QUIET.T_L, QUIET.K_L)
    assert 1 < fitted < 0.9 * true
    # the best of a grid is no better than the fit by more than the grid's own step
    grid = [gap_over_floor(replay, seen, lag, gain) for lag in np.geomspace(0.2, 1.0, 12) for gain in (0.95, 1.0, 1.05)]
    assert fitted < 1.03 * min(grid)


def test_shares_hold_behind_a_recorder(fresh_seed: int) -> None:
    replay = case({"sensor_bias": {"bias_mps2": 0.1}, "constant_resistance": {"resistance_mps2": 0.15}}, fresh_seed)
    plain = log(replay)
    coarse = Recorder(speed_quantum=0.05, speed_lag_s=0.05, dropped=0.02, overrides_per_min=2.0).record(
        plain, fresh_seed
    )
    one, other = (oracle_budget(replay, x) for x in (plain, coarse))
    assert list(one.shares) == list(other.shares)
    # floors rise, the speed's more, and overrides take rows away
    assert other.by_channel["speed"][1] > one.by_channel["speed"][1]
    assert 1 < other.before < one.before


# Visibility: rollout error over noise.
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
