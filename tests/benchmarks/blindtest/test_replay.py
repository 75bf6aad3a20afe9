"""A drive driven again with some of its causes: with all of them it is the drive, to the last of what is not noise."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.blindtest import CALIBRATION, EFFECTS, SEALED, Car, DrivePlan, family, simulate
from benchmarks.blindtest.replay import Replay
from benchmarks.blindtest.vehicle import Run

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
