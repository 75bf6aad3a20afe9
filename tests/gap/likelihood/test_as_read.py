"""Logs straight from a simulator, without sensor noise."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.gap import DeadTime, plant
from avtorch.gap.likelihood.as_read import FINER, NOISE, as_read
from avtorch.io import Log
from avtorch.vehicle import Leader, simulate


def drive(*effects: DeadTime, sigma: float = 0.0, seconds: float = 60.0) -> Log:
    car = plant(list(effects), baseline="T_L=0.4, K_L=0.9", sigma=sigma)
    return simulate(Leader.default(start=48.0), plant=car, duration=seconds).log()


@pytest.mark.parametrize("decimals", [None, 3, 4])
def test_noise_is_added_where_there_is_none(decimals: int | None) -> None:
    log = drive()
    assert log.accel is not None
    assert log.speed is not None
    accel, speed = (x if decimals is None else x.round(decimals) for x in (log.accel, log.speed))
    log = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=accel, speed=speed)
    noisy, told = as_read(log)
    again, _ = as_read(log)
    assert told is not None
    assert "accel and speed" in told
    for name in NOISE:
        before, after = getattr(log, name), getattr(noisy, name)
        # an SD of n draws is off by 1 / sqrt(2 n); five of them
        assert np.std(after - before) == pytest.approx(NOISE[name], rel=5 / np.sqrt(2 * len(before)))
        np.testing.assert_array_equal(after, getattr(again, name))
        assert NOISE[name] > 10 * FINER
    np.testing.assert_array_equal(noisy.accel_cmd, log.accel_cmd)


@pytest.mark.parametrize("name", ["accel", "speed"])
def test_noise_of_its_own_is_left_alone(name: str, rotating_seed: int) -> None:
    """One sensor that is noisy is enough: what the other lacks, the fit finds out."""
    rng = np.random.default_rng(rotating_seed)
    log = drive()
    signals = {"accel": log.accel, "speed": log.speed}
    signals[name] = signals[name] + 2e-3 * rng.standard_normal(log.rows)
    noisy = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, **signals)
    assert as_read(noisy) == (noisy, None)
    rough = drive(sigma=0.1)
    assert as_read(rough) == (rough, None)


@pytest.mark.slow
@pytest.mark.parametrize("effects", [(), (DeadTime(0.15),)], ids=["none", "dead_time"])
def test_a_simulators_own_log_is_judged_by_what_is_in_it(effects: tuple[DeadTime, ...]) -> None:
    """Without the noise both ended in `unknown`: round-off was told apart from nothing."""
    found = diagnose(drive(*effects, seconds=90.0), pairs=False)
    assert found.verdict.name == (effects[0].name if effects else "none")
    assert any("No sensor noise" in note for note in found.notes)
    if effects:
        assert found.winner.parameters["delay_s"].mean == pytest.approx(0.15, abs=0.01)
