"""The oracle's budget, where its shares follow from a sum of squares."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from avtorch.io import Log
from benchmarks.blindtest import Car, DrivePlan, Recorded, Recorder, simulate
from benchmarks.blindtest.oracle_budget import gap_over_floor, oracle_budget
from benchmarks.blindtest.replay import Replay

QUIET = Car(T_L=0.3, K_L=1.0, process_sd=0.0, accel_sd=0.03, speed_sd=0.01)
BIAS, HUM = 0.3, 0.2
EFFECTS: dict[str, dict[str, float]] = {
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
    run = simulate(QUIET, pilot, seconds=62.0, rate_hz=50, effects=EFFECTS, seed=fresh_seed)
    replay = Replay(run, QUIET, EFFECTS, 0.0, fresh_seed)
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
