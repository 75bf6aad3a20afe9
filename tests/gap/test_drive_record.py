"""What of a log counts for a diagnosis, and how rows come in groups."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.gap import plant
from avtorch.gap.drive_record import Record
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
    record = Record.of(log)
    assert record.group == group
    assert record.dt == pytest.approx(dt)
    # all but the first two seconds, in which the actuator's state is not known
    counted = round(2.0 * rate_hz / group) + np.arange(record.rows)
    np.testing.assert_allclose(record.time, log.time[::group][counted], atol=1e-9)
    assert log.accel is not None
    assert log.speed is not None
    assert log.accel_cmd is not None
    for measured, signal in zip(record.measured, (log.accel, log.speed), strict=True):
        np.testing.assert_array_equal(measured, signal.reshape(-1, group)[counted])
    np.testing.assert_allclose(record.command, log.accel_cmd.reshape(-1, group).mean(1)[counted])


def test_drives_are_rolled_out_at_the_logs_rate() -> None:
    log = log_of(seconds=20.0, rate_hz=100)
    (drive,) = Record.of(log).drives
    assert len(drive.time) == log.rows
    assert drive.uniform
    np.testing.assert_array_equal(drive.command.numpy(), log.accel_cmd)


@pytest.mark.parametrize("rate_hz", [20, 40, 100])
def test_the_truth_leaves_nothing_over(rate_hz: int) -> None:
    car = plant(T_L=0.4, K_L=0.9)
    record = Record.of(log_of(car, seconds=40.0, rate_hz=rate_hz, noise=None))
    errors = record.measured - record.rolled_out(car)
    # the first acceleration, taken from 0.3 s, is forgotten within some lags; what it added to the speed is not
    assert np.abs(errors[0]).max() < 2e-2
    assert np.abs(np.diff(errors[1], axis=0)).max() < 2e-3
    assert np.abs(errors[:, errors.shape[1] // 2 :] - errors[:, -1:, -1:]).max() < 1e-6


def _stretches(record: Record) -> list[tuple[float, float]]:
    ends = [*record.starts[1:], record.rows]
    return [(float(record.time[a]), float(record.time[b - 1])) for a, b in zip(record.starts, ends, strict=True)]


def test_standstill_and_a_drivers_foot_do_not_count() -> None:
    log = log_of(seconds=60.0, rate_hz=40)
    assert log.speed is not None
    engaged = (log.time < 20) | (log.time >= 24.5)
    speed = np.where((log.time >= 40) & (log.time < 43), 0.0, log.speed)
    record = Record.of(replace(log, engaged=engaged, speed=speed))
    assert record.group == 2
    # after the driver let go the car settles anew; at rest it went on obeying
    np.testing.assert_allclose(_stretches(record), [(2, 19.95), (26.5, 39.95), (43, 59.95)], atol=1e-6)
    # within a stretch rows follow each other, between two lies a gap
    steps = np.diff(record.source)
    assert (steps[np.diff(record.stretch) == 0] == 1).all()
    assert (steps[np.diff(record.stretch) == 1] > 1).all()
    # rollouts run on through the standstill, and not through the override
    ends = [d.time[[0, -1]].tolist() for d in record.drives]
    np.testing.assert_allclose(ends, [(0, 19.975), (24.5, 59.975)], atol=1e-6)


def test_a_group_with_one_row_that_does_not_count_does_not_count() -> None:
    log = log_of(seconds=30.0, rate_hz=100)
    assert log.speed is not None
    speed = log.speed.copy()
    speed[1503] = 0.0
    record = Record.of(replace(log, speed=speed))
    assert 300 not in record.source
    assert {299, 301} <= set(record.source.tolist())


def test_one_row_in_the_drivers_hand_ends_a_drive_at_whole_groups() -> None:
    log = log_of(seconds=30.0, rate_hz=100)
    engaged = np.ones(log.rows, bool)
    engaged[1503] = False
    record = Record.of(replace(log, engaged=engaged))
    assert [cut.rows for cut in record.cuts] == [slice(0, 1500), slice(1504, 2999)]
    np.testing.assert_allclose(_stretches(record), [(2, 14.95), (17.04, 29.94)], atol=1e-6)


def test_short_stretches_are_left_out() -> None:
    log = log_of(seconds=40.0)
    engaged = (log.time < 20) | ((log.time >= 21) & (log.time < 22)) | (log.time >= 25)
    np.testing.assert_allclose(
        _stretches(Record.of(replace(log, engaged=engaged))), [(2, 19.95), (27, 39.95)], atol=1e-6
    )


def test_segments_are_drives_of_their_own() -> None:
    log = log_of(seconds=60.0, rate_hz=100)
    record = Record.of(_cut(log, slice(0, 1503), slice(1600, 4004), slice(4400, 5950)))
    assert [len(d.time) for d in record.drives] == [1500, 2400, 1550]
    np.testing.assert_allclose(_stretches(record), [(2, 14.95), (18, 39.95), (46, 59.45)], atol=1e-6)
    # measured and rolled out stand at the same rows
    seen = record.at_counted_rows([d.command for d in record.drives])
    np.testing.assert_allclose(seen.mean(-1), record.command)
    at = record.at_counted_rows([d.time for d in record.drives])
    np.testing.assert_allclose(at[:, 0], record.time, atol=1e-6)


def test_several_logs_are_one_after_another() -> None:
    a, b = log_of(seconds=20.0, name="a"), log_of(seconds=30.0, name="b", speed0=25.0)
    record = Record.of([a, b])
    alone = [Record.of(a), Record.of(b)]
    assert record.rows == sum(r.rows for r in alone)
    np.testing.assert_array_equal(record.measured, np.concatenate([r.measured for r in alone], 1))
    parts = [r.rolled_out(plant()) for r in alone]
    np.testing.assert_allclose(record.rolled_out(plant()), np.concatenate(parts, 1), atol=1e-9)
    np.testing.assert_array_equal(Record.of(iter([a])).source, alone[0].source)


@pytest.mark.parametrize("channel", ["accel", "speed"])
def test_one_witness_is_enough(channel: str) -> None:
    record = Record.of(log_of(seconds=20.0, channels=(channel,)))
    assert record.channels == (channel,)
    assert record.measured.shape == (1, record.rows, 1)
    assert (record.drives[0].speed is None) == (channel == "accel")


def test_stamps_that_jitter_in_their_last_digits_are_even() -> None:
    log = log_of(seconds=30.0)
    rng = np.random.default_rng(0)
    stamped = replace(log, time=np.round(log.time + rng.uniform(-4e-4, 4e-4, log.rows), 4))
    assert Record.of(stamped).drives[0].uniform
    lost = np.delete(np.arange(log.rows), [200, 333])
    assert not Record.of(_cut(log, lost)).drives[0].uniform  # type: ignore[arg-type]


def _refused(logs: object, *words: str) -> None:
    with pytest.raises(InputError) as told:
        Record.of(logs)  # type: ignore[arg-type]
    assert "\n" not in str(told.value)
    for word in words:
        assert word in str(told.value)


def test_bad_input_is_one_clear_error() -> None:
    log = log_of(seconds=30.0)
    _refused([], "logs", "none given")
    _refused(replace(log, accel_cmd=None), "drive", "accel_cmd")
    _refused(log_of(seconds=1.5), "0.0 s", "10 s")
    _refused(log_of(seconds=9.0), "7.0 s", "10 s")
    _refused(replace(log, speed=np.zeros(log.rows)), "0.0 s", "moving")
    _refused(replace(log, engaged=np.zeros(log.rows, bool)), "0.0 s", "engaged")
    _refused([log, log_of(seconds=30.0, name="other", channels=("speed",))], "drive", "other", "channels")
    # rows of 25 and 40 Hz do not pass one filter
    _refused([log_of(seconds=30.0, rate_hz=r, name=f"at {r} Hz") for r in (25, 40)], "rate", "at 25 Hz", "at 40 Hz")
