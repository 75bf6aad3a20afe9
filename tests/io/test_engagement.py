"""Returns to `engaged`: which rows follow on one too closely, and what becomes of a log that is full of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avtorch.arrays import BoolArray, IntArray
from avtorch.io import Log, check
from avtorch.io.engagement import SETTLE_S, settled_rows

RATE_HZ = 10


def log_of(engaged: BoolArray, *, segment: IntArray | None = None, clock: float = 0.0) -> Log:
    """A car at 20 m/s that follows its command, with or without a driver in charge."""
    time = clock + np.arange(len(engaged)) / RATE_HZ
    command = np.sin(time)
    return Log.from_arrays(
        name="drive", time=time, accel_cmd=command, accel=command, speed=20 - np.cos(time), engaged=engaged.astype(int),
        segment=segment,
    )  # fmt: skip


@given(st.lists(st.booleans(), min_size=2, max_size=120), st.sampled_from([0.0, 1.7e9]))
def test_rows_settle_for_two_seconds_after_every_return(engaged: list[bool], clock: float) -> None:
    on = np.array(engaged)
    log = log_of(on, clock=clock)
    wait = round(SETTLE_S * RATE_HZ)
    for row in range(len(on)):
        earlier = np.flatnonzero(~on[: row + 1])
        # the row of the return and those of the 2 s from it
        assert log.settled[row] == (not len(earlier) or row - earlier[-1] > wait)
    assert not (log.usable & ~on).any()
    # drives hold every engaged row once, and no other
    held = [r for part in log.engaged_segments() for r in range(part.start, part.stop)]
    assert held == np.flatnonzero(on).tolist()


@given(st.lists(st.booleans(), min_size=2, max_size=60), st.integers(1, 59))
def test_a_stream_cut_anywhere_gives_the_same_answer_as_a_log(engaged: list[bool], cut: int) -> None:
    on, time = np.array(engaged), np.arange(len(engaged)) / RATE_HZ
    whole, last = settled_rows(time, on)
    first, before = settled_rows(time[:cut], on[:cut])
    second, after = settled_rows(time[cut:], on[cut:], before)
    np.testing.assert_array_equal(np.concatenate([first, second]), whole)
    assert after == last


def test_a_segment_behind_an_override_begins_with_a_return() -> None:
    """It is unknown whether the driver had let go before the gap ended."""
    on, segment = np.ones(200, bool), np.repeat([0, 1], 100)
    on[90:100] = False
    log = log_of(on, segment=segment)
    assert not log.settled[100:121].any()
    assert log.settled[121:].all()
    assert log.engaged_segments() == [slice(0, 90), slice(100, 200)]
    on[90:100] = True
    on[80:90] = False
    # two seconds after the return the segment has ended; the next one is a drive of its own
    assert log_of(on, segment=segment).settled[100:].all()


@pytest.mark.parametrize(
    ("driven", "returns", "settling", "usable"),
    [
        (slice(0, 0), 0, 0, 200),
        (slice(0, 50), 1, 20, 130),
        (slice(150, 200), 0, 0, 150),
        (slice(60, 90), 1, 20, 150),
        (slice(0, 200), 0, 0, 0),
        (slice(0, 200, 2), 100, 100, 0),
    ],
    ids=["none", "at the start", "at the end", "between", "all", "every other row"],
)
def test_the_look_at_a_log_counts_returns_and_what_settles(
    driven: slice, returns: int, settling: int, usable: int
) -> None:
    on = np.ones(200, bool)
    on[driven] = False
    log = log_of(on)
    seen = check(log)
    assert (seen.returns, seen.settling_rows) == (returns, settling)
    assert log.usable.sum() == usable == 200 - seen.masked_rows
    said = [note for note in seen.notes if "to engaged" in note]
    assert len(said) == bool(returns)
    if returns:
        assert f"{returns} return" in said[0]
        assert f"{settling / RATE_HZ:.1f} s of settling masked" in said[0]
    assert ("no row is left to estimate from" in seen.notes) == (usable == 0)


def test_a_driver_who_drives_on_against_the_brake_is_no_standstill() -> None:
    """Without a speed a stop is detected by a brake without response: here the car ignores the brake command."""
    time = np.arange(600) / RATE_HZ
    on = (time < 20) | (time >= 35)
    # the command brakes all through the override, the driver cruises
    command = np.where(on, 0.5 * np.sin(time - 35), -1.5)
    accel = np.where(on, command, 0.0)
    log = Log.from_arrays(name="drive", time=time, accel_cmd=command, accel=accel, engaged=on.astype(int))
    assert log.moving[on].all()
