"""A log without speed: stops are detected by a brake without response, and a moving car is never taken for a standing
one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch.io import STANDSTILL_MPS, Log, check
from avtorch.io.standstill import standing

DT = 0.02


def answered(command: np.ndarray, *, lag: float, gain: float, delay: float = 0.0) -> np.ndarray:
    """GLVD's acceleration for a held command, `delay` [s] late."""
    late = np.concatenate([np.zeros(round(delay / DT)), command])[: len(command)]
    keep = np.exp(-DT / lag)
    return np.asarray(lfilter([0.0, gain * (1 - keep)], [1.0, -keep], late))


def stop(rest_s: float, rng: np.random.Generator, *, lag: float = 0.4, bias: float = 0.0) -> Log:
    """Brakes from 10 m/s to a stop, waits with the brake on, and goes; white noise of 0.08 m/s² on accel."""
    command = np.concatenate([np.zeros(100), np.full(800, -0.9)])
    accel = answered(command, lag=lag, gain=0.95)
    speed = 10 + np.cumsum(accel) * DT
    stops = int(np.argmax(speed <= 0))
    rest = round(rest_s / DT)
    on = np.full(500, 1.0)
    command = np.concatenate([command[:stops], np.full(rest, -0.9), on])
    accel = np.concatenate([accel[:stops], np.zeros(rest), answered(on, lag=lag, gain=0.95)])
    speed = np.maximum(np.concatenate([[10.0], 10 + np.cumsum(accel)[:-1] * DT]), 0.0)
    seen = accel + bias + 0.08 * rng.standard_normal(len(accel))
    return Log.from_arrays(time=np.arange(len(accel)) * DT, accel_cmd=command, accel=seen, speed=speed)


@pytest.mark.statistical
@pytest.mark.parametrize("rest_s", [1.2, 4.0, 40.0])
@pytest.mark.parametrize("bias", [0.0, -0.08])
def test_a_stop_is_masked_from_slow_to_slow(rest_s: float, bias: float, rotating_seed: int) -> None:
    log = stop(rest_s, np.random.default_rng(rotating_seed), bias=bias)
    blind = replace(log, speed=None)
    slow = ~log.moving
    taken = ~blind.moving
    # the two ends, where the speed is integrated from noise: 0.3 m/s are passed in 0.35 s of braking and 0.9 s of going
    assert (taken ^ slow).sum() * DT < 0.5
    assert taken[slow].mean() > 0.75
    assert f"{taken.sum()} rows masked: standstill (braked, yet not slowing)" in check(blind).notes


@pytest.mark.statistical
def test_a_car_that_moves_is_never_taken_for_one_that_stands(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    # of 87 000 such cars, whose demand leaps by up to 5 m/s² every two seconds, 2 are taken for standing
    for _ in range(40):
        holds = rng.integers(40, 250, 20)
        command = np.repeat(rng.uniform(-3, 2, 20), holds)
        lag, gain, delay = rng.uniform([0.1, 0.5, 0.0], [0.9, 1.1, 0.8])
        accel = answered(command, lag=lag, gain=gain, delay=delay) + 0.08 * rng.standard_normal(len(command))
        assert not standing(command, accel, DT, STANDSTILL_MPS).any()


def test_no_brake_no_stop() -> None:
    rows = 2000
    assert not standing(np.full(rows, -0.2), np.zeros(rows), DT, STANDSTILL_MPS).any()
    assert standing(np.full(rows, -0.8), np.zeros(rows), DT, STANDSTILL_MPS)[200:].all()


def test_each_drive_has_its_own_stops(fresh_seed: int) -> None:
    log = stop(4.0, np.random.default_rng(fresh_seed))
    twice = replace(
        log,
        speed=None,
        **{n: np.tile(getattr(log, n), 2) for n in ("time", "accel_cmd", "accel", "engaged")},
        segment=np.repeat([0, 1], log.rows),
    )
    np.testing.assert_array_equal(twice.moving, np.tile(replace(log, speed=None).moving, 2))
