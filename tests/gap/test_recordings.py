"""A real recording: three laps of a Genesis at a test field, commanded acceleration and measured speed, 100 Hz.

The log has no accelerometer and the cause is unknown, so the tests check properties common to all three laps. Named
effects are tested with the demand of the same laps sent to another car, one with an effect in it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import avtorch
from avtorch.gap import RoadGrade
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.inference import infer
from avtorch.gap.engine.sample import sample
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.parameters import road_along
from avtorch.io import Log
from benchmarks.blindtest.car import Car
from benchmarks.blindtest.drives import Recorded
from benchmarks.blindtest.vehicle import simulate

LAPS = (1, 2, 3)


@pytest.fixture(scope="module")
def laps(data_dir: Path) -> dict[int, Log]:
    return {k: Log.read(data_dir / "genesis" / f"lap{k}.csv") for k in LAPS}


# --- the laps themselves


@pytest.fixture(scope="module", params=["glvd", "dead_time=0.17"])
def answers(laps: dict[int, Log], request: pytest.FixtureRequest) -> dict[int, Diagnosis]:
    # pairs, which take most of the time, only on top of the bare GLVD
    return {k: avtorch.diagnose(log, baseline=request.param, pairs=request.param == "glvd") for k, log in laps.items()}


@pytest.mark.slow
def test_no_lap_blames_an_effect_for_sure(answers: dict[int, Diagnosis]) -> None:
    for answer in answers.values():
        # speed alone, one minute: nothing is blamed for sure
        assert max(c.probability for c in answer.candidates if c.effects) < 0.9


@pytest.fixture(scope="module")
def bases(laps: dict[int, Log]) -> dict[int, Hypothesis]:
    """GLVD behind its recorder, as the engine judges speed alone."""
    return {k: infer(DriveData.of(log), effects=("road_grade",), most=1).base for k, log in laps.items()}


@pytest.mark.slow
@pytest.mark.parametrize("lap", LAPS)
def test_lag_and_delay_from_the_laps(bases: dict[int, Hypothesis], lap: int) -> None:
    found = fit(bases[lap].with_effect("dead_time", (0.1,)), 20)
    # lag and delay together are known to a tenth of a second, of the delay alone little more than a bound
    draws = sample(found, chains=1, draws=4000, method="laplace")
    lag, delay = draws["T_L"].ravel(), draws["dead_time"].ravel()
    assert (lag + delay).std() < 0.1
    assert delay.mean() < 3 * delay.std()
    assert np.corrcoef(lag, delay)[0, 1] < -0.3
    assert 0.05 < (lag + delay).mean() < 0.4


@pytest.mark.slow
def test_one_pole_will_do(laps: dict[int, Log]) -> None:
    """3 nats are twenty to one: a result of one lap out of three does not belong to the car."""
    tried = ("dead_time", "second_order_actuator")
    found = [avtorch.diagnose(log, effects=[*tried, "road_grade", "gust"], pairs=False) for log in laps.values()]
    for name in tried:
        gains = [c.log_evidence or 0.0 for answer in found for c in answer.candidates if c.name == name]
        assert sum(gain > 3 for gain in gains) <= 1, (name, gains)


@pytest.mark.slow
def test_a_force_returns_at_the_same_places_each_lap(bases: dict[int, Hypothesis]) -> None:
    """The field is flat: what comes back at the same metres as a slope does is the curves' own resistance."""
    metres, forces = np.arange(0.0, 400.0, 2.0), []
    for base in bases.values():
        road = road_along(base, RoadGrade(0.02))
        place = base.data.position - base.data.position[0]
        force = road.columns(torch.as_tensor(place)) @ torch.as_tensor(road.profile)
        forces.append(np.interp(metres, place, force.numpy()))
    # of unrelated slopes with some ten bends each the mean of the three is 0 with a standard deviation of 0.2
    assert np.corrcoef(forces)[np.triu_indices(3, 1)].mean() > 0.6


# --- the demand of a lap, another car's answer

EFFECTS = {
    "dead_time": {"delay_s": 0.25},
    "dead_band": {"half_width_mps2": 0.2},
    # the laps' demand is gentle: a limit of 0.8 m/s³ is never met, and none is the right answer to it
    "rate_limit": {"jerk_max_mps3": 0.3},
    "aerodynamic_drag": {"drag_per_m": 1e-3, "wind_mps": 0.0, "wind_swing_mps": 0.0, "wind_period_s": 60.0},
    "sensor_scale": {"scale": 1.15},
    "sensor_bias": {"bias_mps2": 0.2},
}


def driven(lap: Log, effects: dict[str, dict[str, float]], seed: int) -> Log:
    """The reference vehicle under the lap's demand, open loop, with both channels and the noise of production sensors.

    It starts 5 m/s faster than the lap did: without the loop around it the speed drifts, and must not come to rest.
    """
    assert lap.accel_cmd is not None
    assert lap.speed is not None
    car = Car(T_L=0.5, K_L=0.92, process_sd=0.04, accel_sd=0.05, speed_sd=0.005)
    pilot = Recorded(lap.accel_cmd, start_speed=float(lap.speed[0]) + 5)
    run = simulate(car, pilot, seconds=lap.rows / 100, rate_hz=100, effects=effects, seed=seed)
    return Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


@pytest.mark.slow
@pytest.mark.parametrize("effect", EFFECTS)
def test_an_effect_injected_into_a_recording_is_named(laps: dict[int, Log], effect: str) -> None:
    given = EFFECTS[effect]
    answer = avtorch.diagnose(driven(laps[2], {effect: given}, seed=2), pairs=False)
    assert answer.verdict.names == (effect,)
    key, value = next(iter(given.items()))
    told = answer.winner.parameters[key]
    # four standard deviations, and what the equations of the two cars differ by
    assert abs(told.mean - value) < 4 * told.sd + 0.05 * abs(value)


@pytest.mark.slow
def test_nothing_injected_nothing_named(laps: dict[int, Log]) -> None:
    answer = avtorch.diagnose(driven(laps[2], {}, seed=2), pairs=False)
    assert answer.verdict.names == ("none",)
