"""What is left over: nothing of white errors, in a loop or not; something wherever structure was put in."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter
from avtorch.gap.selection.adequacy import Adequacy, adequacy
from avtorch.io import Log
from tests.gap.records import BOTH, QUIET, errors_of, log_of, ornstein, record_of

CHANCE = 15.0
"""Nats that a Bayes factor exceeds by chance with probability below exp(-15) = 3e-7."""

NAMES = ("flexible", "drift", "line", "memory", "bursts")


def _left(record: Record, errors: FloatArray, rollout: FloatArray | None = None, explained: float = 0.0) -> Adequacy:
    rollout = record.measured if rollout is None else rollout
    return adequacy(WhiteningFilter(record, QUIET), errors, rollout, explained=explained)


@pytest.fixture(scope="module")
def quiet() -> Record:
    return Record.of(log_of(noise=None, seconds=240.0))


@pytest.mark.statistical
@pytest.mark.parametrize("channels", [BOTH, ("accel",), ("speed",)])
def test_nothing_is_left_of_noise(channels: tuple[str, ...], rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    record = record_of(120.0, noise=None, channels=channels)
    for _ in range(3):
        left = _left(record, errors_of(QUIET, record, rng))
        assert max(getattr(left, n) for n in NAMES) < CHANCE
        assert left.total < CHANCE


@pytest.mark.statistical
def test_a_loop_that_feeds_noise_back_feigns_nothing(rotating_seed: int) -> None:
    """Cruise at 100 Hz on noisy readings, rows in groups of five."""
    rng = np.random.default_rng(rotating_seed)
    dt, rows, lag = 0.01, 24000, 0.3
    fine = QUIET.replaced(accel_sd=0.1, speed_sd=0.05)
    process, drifted = ornstein(fine.process_sd, fine.process_time, rows, dt, rng)
    seen = rng.standard_normal((2, rows)) * np.array([[fine.accel_sd], [fine.speed_sd]])
    a, v, told = 0.0, 20.0, np.zeros((3, rows))
    keep = np.exp(-dt / lag)
    for i in range(rows):
        accel, speed = a + process[i] + seen[0, i], v + drifted[i] + seen[1, i]
        u = 0.8 * (20.0 - speed) - 0.4 * accel
        told[:, i] = accel, speed, u
        v += u * dt + lag * (1 - keep) * (a - u)
        a = u + keep * (a - u)
    log = Log.from_arrays(name="cruise", time=dt * np.arange(rows), accel=told[0], speed=told[1], accel_cmd=told[2])
    record = Record.of(log)
    assert record.group == 5
    errors = np.stack([process + seen[0], drifted + seen[1]]).reshape(2, -1, 5)[:, record.source]
    left = adequacy(WhiteningFilter(record, fine.replaced(force_sd=1e-4)), errors, record.measured - errors)
    assert max(getattr(left, n) for n in NAMES) < CHANCE


def _pushed(record: Record, force: FloatArray) -> FloatArray:
    return np.stack([force, np.cumsum(force) * record.dt])[..., None]


def _bent(record: Record, rng: np.random.Generator) -> FloatArray:
    a = record.measured[0, :, 0]
    return _pushed(record, 0.1 * a * np.abs(a))


def _late_now_and_then(record: Record, rng: np.random.Generator) -> FloatArray:
    """Half a second late in every other stretch of ten seconds, early in the rest."""
    jerk = np.gradient(record.measured[0, :, 0]) / record.dt
    turn = np.sign(np.sin(2 * np.pi * np.arange(record.rows) * record.dt / 20.0))
    return _pushed(record, 0.15 * jerk * turn)


def _swinging(record: Record, rng: np.random.Generator) -> FloatArray:
    return _pushed(record, 0.05 * np.sin(2.3 * record.dt * np.arange(record.rows) + 1.0))


def _slow_sensor(record: Record, rng: np.random.Generator) -> FloatArray:
    """Readings of the accelerometer with an error that lasts."""
    return np.stack([ornstein(0.05, 1.0, record.rows, record.dt, rng)[0], np.zeros(record.rows)])[..., None]


def _rough(record: Record, rng: np.random.Generator) -> FloatArray:
    """More noise the harder the car pulls."""
    size = 0.15 * np.abs(record.measured[0, :, 0])
    return np.stack([size * rng.standard_normal(record.rows), np.zeros(record.rows)])[..., None]


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("put_in", "name"),
    [
        (_bent, "flexible"),
        (_late_now_and_then, "drift"),
        (_swinging, "line"),
        (_slow_sensor, "memory"),
        (_rough, "bursts"),
    ],
)
def test_structure_is_seen_by_its_own_question(
    put_in: Callable[[Record, np.random.Generator], FloatArray], name: str, quiet: Record, rotating_seed: int
) -> None:
    rng = np.random.default_rng(rotating_seed)
    left = _left(quiet, errors_of(QUIET, quiet, rng) + put_in(quiet, rng))
    assert getattr(left, name) > 2 * CHANCE
    assert left.total > CHANCE


def test_what_random_causes_explain_is_taken_off(quiet: Record, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    errors = errors_of(QUIET, quiet, rng) + _bent(quiet, rng)
    whole, less = _left(quiet, errors), _left(quiet, errors, explained=10.0)
    none = _left(quiet, errors, explained=1e6)
    assert less.flexible == pytest.approx(whole.flexible - 10.0)
    assert none.total <= 0.0
    assert none.line == pytest.approx(min(whole.line, 0.0))


def test_two_questions_weigh_as_the_mean_of_their_factors() -> None:
    left = Adequacy(flexible=40.0, drift=-3.0, line=-2.0, memory=-5.0, bursts=0.0, tails=1000.0)
    assert left.total == pytest.approx(40.0 - np.log(5.0), abs=1e-9)
    assert left.vector().tolist() == [40.0, -3.0, -2.0, -5.0, 0.0, 1000.0]
