"""Logs straight from a simulator, without sensor noise."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.gap import DeadTime, plant
from avtorch.gap.sensor_noise import ADDED, FINER, with_sensor_noise
from avtorch.io import Log
from avtorch.vehicle import Leader, simulate


def drive(*effects: DeadTime, sigma: float = 0.0, seconds: float = 60.0) -> Log:
    car = plant(list(effects), baseline="T_L=0.4, K_L=0.9", sigma=sigma)
    return simulate(Leader.default(start=48.0), plant=car, duration=seconds).log()


def again(log: Log, **channels: np.ndarray | None) -> Log:
    return Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, **channels)


@pytest.mark.slow
@pytest.mark.parametrize("decimals", [None, 3, 4])
@pytest.mark.parametrize("sigma", [0.0, 0.1])
def test_noise_is_added_where_there_is_none(decimals: int | None, sigma: float) -> None:
    log = drive(sigma=sigma)
    assert log.accel is not None
    assert log.speed is not None
    accel, speed = (x if decimals is None else x.round(decimals) for x in (log.accel, log.speed))
    log = again(log, accel=accel, speed=speed)
    read, told = with_sensor_noise(log)
    assert told is not None
    assert "accel (0.02 m/s²) and speed (0.01 m/s)" in told
    for name, sd, before in (("accel", ADDED["accel"], accel), ("speed", ADDED["speed"], speed)):
        after = getattr(read, name)
        # from row to row the force hardly changes; an SD of n draws is off by 1 / sqrt(2 n), five of them
        seen = np.std(np.diff(after - before)) / np.sqrt(2)
        assert seen == pytest.approx(sd, rel=5 / np.sqrt(2 * len(before)))
        np.testing.assert_array_equal(after, getattr(with_sensor_noise(log)[0], name))
        assert sd > 10 * FINER[name]
    np.testing.assert_array_equal(read.accel_cmd, log.accel_cmd)
    # what pushes the car gains the speed that it should
    force = np.asarray(read.accel) - accel
    gained = np.cumsum(force[:-1] * np.diff(log.time))
    rows = len(gained)
    # white noise of the sensors apart, whose sum walks off by as much as this
    off = 5 * (ADDED["accel"] * 0.01 * np.sqrt(rows) + ADDED["speed"])
    assert abs(gained[-1] - (np.asarray(read.speed) - speed)[-1]) < off


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("name", ["accel", "speed"])
def test_a_witness_with_noise_of_its_own_gets_none(name: str, rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    log = drive()
    signals = {"accel": log.accel, "speed": log.speed}
    signals[name] = signals[name] + 5e-3 * rng.standard_normal(log.rows)
    both = again(log, **signals)
    read, told = with_sensor_noise(both)
    other = "speed" if name == "accel" else "accel"
    assert told is not None
    assert told.startswith(f"No sensor noise in {other}, ")
    # the force only, which is slow
    added = getattr(read, name) - getattr(both, name)
    assert np.std(np.diff(added)) < 1e-3


@pytest.mark.slow
def test_what_was_interpolated_is_no_simulation(fresh_seed: int) -> None:
    """A sensor of 2 Hz, brought to 10 Hz by straight lines; and speed alone, which is left as it is."""
    rng = np.random.default_rng(fresh_seed)
    time = np.arange(600) * 0.1
    few = np.arange(0, 61, 0.5)
    seen = {"accel": np.sin(0.3 * few), "speed": 20 - np.cos(0.3 * few) / 0.3}
    signals = {name: np.interp(time, few, x + 0.05 * rng.standard_normal(len(few))) for name, x in seen.items()}
    log = Log.from_arrays(time=time, accel_cmd=np.sin(0.3 * time), **signals)
    assert with_sensor_noise(log) == (log, None)
    log = drive()
    alone = again(log, speed=log.speed)
    assert with_sensor_noise(alone) == (alone, None)


@pytest.mark.slow
@pytest.mark.parametrize(("effects", "sigma"), [((), 0.1), ((DeadTime(0.15),), 0.0)], ids=["none", "dead_time"])
def test_a_simulators_own_log_is_diagnosed_by_its_content(effects: tuple[DeadTime, ...], sigma: float) -> None:
    """Without the noise these ended in `unknown`, `gust` or an oscillation, fitted to round-off."""
    found = diagnose(drive(*effects, sigma=sigma, seconds=90.0), pairs=False)
    # commands below 0.6 Hz do not tell a delay of 0.15 s behind a lag from two lags
    assert found.verdict.name in (("dead_time", "second_order_actuator") if effects else ("none",))
    assert any("No sensor noise" in note for note in found.notes)
