"""What of a log counts, how rows come in groups, and what a simulator makes of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.gap import plant
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.io import Log
from tests.gap.records import log_of


def _cut(log: Log, *parts: slice) -> Log:
    """The log with only these rows, each part a drive of its own."""
    rows = np.concatenate([np.arange(log.rows)[p] for p in parts])
    number = np.concatenate([np.full(len(np.arange(log.rows)[p]), i) for i, p in enumerate(parts)])
    cut = {name: getattr(log, name)[rows] for name in ("time", "accel_cmd", "accel", "speed")}
    return Log.from_arrays(name=log.name, segment=number, **cut)


@pytest.mark.parametrize(
    ("rate_hz", "group", "dt"), [(10, 1, 0.1), (20, 1, 0.05), (25, 1, 0.04), (50, 2, 0.04), (100, 5, 0.05)]
)
def test_rows_are_averaged_down_to_some_twenty_a_second(rate_hz: int, group: int, dt: float) -> None:
    log = log_of(seconds=20.0, rate_hz=rate_hz)
    rows = CountedRows.of(log)
    assert rows.group == group
    assert rows.dt == pytest.approx(dt)
    # all but the first two seconds, in which the actuator's state is not known
    counted = round(2.0 * rate_hz / group) + np.arange(rows.rows)
    np.testing.assert_allclose(rows.time, log.time.reshape(-1, group).mean(1)[counted], atol=1e-9)
    assert log.accel is not None
    assert log.speed is not None
    assert log.accel_cmd is not None
    for measured, signal in zip(rows.measured, (log.accel, log.speed), strict=True):
        np.testing.assert_array_equal(measured, signal.reshape(-1, group)[counted])
    np.testing.assert_allclose(rows.command, log.accel_cmd.reshape(-1, group).mean(1)[counted])
    # another log of the same rows
    np.testing.assert_array_equal(rows.of_logs([log]), rows.measured)


@pytest.mark.parametrize("rate_hz", [20, 40, 100])
def test_the_truth_leaves_nothing_over(rate_hz: int) -> None:
    car = plant(T_L=0.4, K_L=0.9)
    rows = CountedRows.of(log_of(car, seconds=40.0, rate_hz=rate_hz, noise=None))
    errors = rows.measured - rows.rolled_out(car)
    # the first acceleration, taken from half a second, is forgotten within some lags; what it added to the speed is not
    assert np.abs(errors[0]).max() < 2e-2
    assert np.abs(errors[0, errors.shape[1] // 2 :]).max() < 1e-6
    away = errors[1] - errors[1, -1, -1]
    assert np.abs(away[len(away) // 2 :]).max() < 1e-6
    assert rows.rms(errors)["speed"] < 1e-2


def _stretches(rows: CountedRows) -> list[tuple[float, float]]:
    return [(float(rows.time[part.start]), float(rows.time[part.stop - 1])) for part in rows.stretches]


def test_standstill_and_a_drivers_foot_do_not_count() -> None:
    log = log_of(seconds=80.0, rate_hz=20)
    assert log.speed is not None
    engaged = (log.time < 20) | (log.time >= 24.5)
    speed = np.where((log.time >= 45) & (log.time < 50), 0.0, log.speed)
    found = _stretches(CountedRows.of(replace(log, engaged=engaged, speed=speed)))
    # behind the driver's hand and a standstill the car settles anew; the speed is smoothed
    np.testing.assert_allclose(found, [(2, 19.95), (26.5, 45.0), (52, 79.95)], atol=1.0)


def test_short_stretches_are_left_out() -> None:
    log = log_of(seconds=50.0)
    engaged = (log.time < 20) | ((log.time >= 21) & (log.time < 30)) | (log.time >= 32)
    found = _stretches(CountedRows.of(replace(log, engaged=engaged)))
    np.testing.assert_allclose(found, [(2, 19.95), (34, 49.95)], atol=1e-6)


def test_segments_are_drives_of_their_own() -> None:
    log = log_of(seconds=60.0, rate_hz=100)
    rows = CountedRows.of(_cut(log, slice(0, 1503), slice(1600, 4004), slice(4400, 5950)))
    assert len(rows.drives) == len(rows.stretches) == 3
    np.testing.assert_allclose(_stretches(rows), [(2.02, 14.97), (18.02, 39.97), (46.02, 59.47)], atol=0.06)


def test_several_logs_are_one_after_another() -> None:
    a, b = log_of(seconds=20.0, name="a"), log_of(seconds=30.0, name="b", speed0=25.0)
    rows = CountedRows.of([a, b])
    alone = [CountedRows.of(x) for x in (a, b)]
    assert rows.rows == sum(r.rows for r in alone)
    np.testing.assert_array_equal(rows.measured, np.concatenate([r.measured for r in alone], 1))
    np.testing.assert_array_equal(rows.of_logs([a, b]), rows.measured)
    parts = [r.rolled_out(plant()) for r in alone]
    # but for a row more or less in the mean that is the first acceleration, which is forgotten
    np.testing.assert_allclose(rows.rolled_out(plant()), np.concatenate(parts, 1), atol=5e-3)


@pytest.mark.parametrize("channel", ["accel", "speed"])
def test_one_witness_is_enough(channel: str) -> None:
    rows = CountedRows.of(log_of(seconds=20.0, channels=(channel,)))
    assert rows.channels == (channel,)
    assert rows.rolled_out(plant()).shape == rows.measured.shape == (1, rows.rows, 1)


def _refused(logs: object, *words: str) -> None:
    with pytest.raises(InputError) as told:
        CountedRows.of(logs)  # type: ignore[arg-type]
    assert "\n" not in str(told.value)
    for word in words:
        assert word in str(told.value)


def test_bad_input_is_one_clear_error() -> None:
    log = log_of(seconds=30.0)
    _refused([], "logs", "none given")
    _refused(replace(log, accel_cmd=None), "drive", "accel_cmd")
    _refused(log_of(seconds=9.0), "9.0 s", "12 s")
    _refused(replace(log, speed=np.zeros(log.rows)), "0.0 s", "moving")
    _refused(replace(log, engaged=np.zeros(log.rows, bool)), "0.0 s", "engaged")
    _refused([log, log_of(seconds=30.0, name="other", channels=("speed",))], "drive", "other", "channels")
    # rows of 25 and 40 Hz do not pass one filter
    _refused([log_of(seconds=30.0, rate_hz=r, name=f"at {r} Hz") for r in (25, 40)], "rate", "at 25 Hz", "at 40 Hz")
