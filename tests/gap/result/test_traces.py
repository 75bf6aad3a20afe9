"""The drives beside their rollouts: the fit by what its definition says of simple signals, and what did not count."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch import Log
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.traces import Traces, uncounted


def test_the_fit_of_the_exact_the_mean_and_a_known_error() -> None:
    time = np.linspace(0.0, 20 * np.pi, 2001)[:-1]  # whole periods
    measured = np.stack([np.sin(time), 20 + 3 * np.sin(time)])
    wrong = measured + np.array([[0.25], [3.0]]) * np.cos(time)  # as large as a quarter of the spread, and as all of it
    zeros = np.zeros(len(time))
    traces = Traces(time, zeros, ("accel", "another"), measured, measured, wrong, zeros, zeros.astype(int))
    assert traces.fit(traces.before).tolist() == [100.0, 100.0]
    assert traces.fit(traces.after) == pytest.approx([75.0, 0.0], abs=1e-9)
    mean = np.broadcast_to(measured.mean(axis=1, keepdims=True), measured.shape)
    assert traces.fit(mean) == pytest.approx([0.0, 0.0], abs=1e-9)
    # an offset is an error, as is a simulator worse than the mean
    assert traces.fit(measured + 6.0)[1] == pytest.approx(100 * (1 - 6 / (3 / np.sqrt(2))))


def test_a_channel_that_stands_still_has_no_fit() -> None:
    still, zeros = np.full((1, 50), 4.0), np.zeros(50)
    traces = Traces(np.arange(50.0), zeros, ("speed",), still, still, still, zeros, zeros.astype(int))
    assert np.isnan(traces.fit(traces.after)).all()


def test_a_simulated_speed_begins_anew_every_ten_seconds_and_in_each_stretch() -> None:
    time = 0.05 * np.concatenate([np.arange(500), np.arange(600, 700)])  # 25 s, 5 s without rows, 5 s
    stretch = np.repeat([0, 1], [500, 100])
    speed, zeros = 20 + np.sin(time), np.zeros(600)
    drifting = speed + 7.0 + 0.4 * time
    traces = Traces(time, zeros, ("speed",), speed[None], drifting[None], speed[None], zeros, stretch)
    assert [run.stop - run.start for run in traces.runs] == [200, 200, 100, 100]
    off = traces.begun_anew(traces.before)[0] - speed
    since = np.concatenate([0.05 * (np.arange(500) % 200), 0.05 * np.arange(100)])
    # from the mean of the first half second, 10 rows, on
    np.testing.assert_allclose(off, 0.4 * (since - 0.225), atol=1e-9)
    np.testing.assert_allclose(traces.begun_anew(traces.after)[0], speed)
    accel = Traces(time, zeros, ("accel",), speed[None], drifting[None], speed[None], zeros, stretch)
    assert accel.begun_anew(accel.before) is accel.before


def drive(rate: float, *, taken: bool = True) -> Log:
    """90 s: the driver from 20 to 25 s, standstill from 40 to 44 s, no rows from 60 to 62 s."""
    time = np.arange(0.0, 90.0, 1 / rate)
    time = time[(time < 60.0) | (time >= 62.0)]
    speed = np.where((time >= 40.0) & (time < 44.0), 0.0, 10.0 + np.sin(time))
    engaged = (time < 20.0) | (time >= 25.0)
    more = {"engaged": engaged.astype(float)} if taken else {}
    return Log.from_arrays(time=time, accel_cmd=np.cos(time), speed=speed, **more)


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0])
def test_each_reason_is_found_where_it_is(rate: float) -> None:
    log = drive(rate)
    found = uncounted([log], record := CountedRows.of([log]))
    spans = [(x.why, x.begin, x.end) for x in found]
    near = pytest.approx
    row = 2 * record.dt
    whys = ["settling", "driver", "settling", "standstill", "settling", "gap", "settling"]
    assert [why for why, *_ in spans] == whys
    ends = [(0.0, 2.0), (20.0, 25.0), (25.0, 27.0), (40.0, 44.0), (44.0, 46.0), (60.0, 62.0), (62.0, 64.0)]
    for (why, begin, end), (a, b) in zip(spans, ends, strict=True):
        slack = 0.6 if 40.0 <= a <= 44.0 else row  # the speed is smoothed: its noise is no stop
        assert (begin, end) == (near(a, abs=slack), near(b, abs=slack)), why
    # together with what counts they are the whole drive
    assert sum(x.end - x.begin for x in found) + record.rows * record.dt == near(90.0, abs=8 * row)


def test_of_several_logs_each_has_its_own() -> None:
    logs = [drive(20.0, taken=False), drive(20.0)]
    found = uncounted(logs, CountedRows.of(logs))
    assert [x.log for x in found if x.why == "driver"] == [1]
    assert [x.log for x in found if x.why == "standstill"] == [0, 1]
