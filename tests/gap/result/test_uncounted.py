"""What did not count, and why, of logs made so that each reason is there."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch import Log
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.traces import uncounted


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
