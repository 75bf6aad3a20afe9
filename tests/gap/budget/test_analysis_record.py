"""Drives at the budget's rate: what a command sums to is kept, and rows that are masked count for nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.errors import InputError
from avtorch.gap.budget.analysis_record import RATE_HZ, AnalysisRecord
from tests.gap.budget.cars import log_of


def test_a_command_keeps_its_integral() -> None:
    log = log_of(seconds=60.0, dt=0.01)
    record = AnalysisRecord.of([log])
    assert record.dt == pytest.approx(1 / RATE_HZ)
    assert log.accel_cmd is not None
    held = np.append(0.0, np.cumsum(log.accel_cmd[:-1] * np.diff(log.time)))
    summed = np.cumsum(record.command) * record.dt
    ends = record.time + record.dt
    np.testing.assert_allclose(summed, np.interp(ends, log.elapsed, held), atol=1e-9)


def test_a_car_that_accelerates_does_so_to_the_last_row() -> None:
    """Readings are averaged around each row, also where a drive ends."""
    log = log_of(seconds=60.0, dt=0.01)
    record = AnalysisRecord.of([replace(log, speed=10.0 + 0.3 * log.elapsed, accel=0.3 + 0.0 * log.elapsed)])
    np.testing.assert_allclose(record.measured[:, record.counts], 0.3, rtol=1e-9)


def test_a_slow_log_is_taken_row_by_row() -> None:
    log = log_of(seconds=80.0, dt=0.1)
    record = AnalysisRecord.of([log])
    assert log.accel_cmd is not None
    np.testing.assert_allclose(record.command, log.accel_cmd[: record.rows], atol=1e-9)
    assert log.accel is not None
    np.testing.assert_allclose(record.measured[1], log.accel[: record.rows], atol=1e-9)


def test_rows_that_a_driver_overrides_count_for_nothing_and_nor_do_those_after_them() -> None:
    log = log_of(seconds=80.0)
    engaged = np.ones(log.rows, bool)
    engaged[600:700] = False
    record = AnalysisRecord.of([replace(log, engaged=engaged)])
    begin, end = log.elapsed[600], log.elapsed[699]
    during = (record.time >= begin) & (record.time < end + 2.5)
    assert not record.counts[during].any()
    # settling, and the rest of a block that is mostly masked
    later = (record.time > end + 12.0) & (record.time < log.elapsed[-1] - 1.0)
    assert record.counts[later].all()


def test_blocks_are_numbered_and_do_not_cross_stretches() -> None:
    log = log_of(seconds=90.0)
    record = AnalysisRecord.of([replace(log, segment=(log.time > 45.0).astype(int))])
    assert len(record.stretches) == 2
    first, second = (set(record.block[s.rows]) - {-1} for s in record.stretches)
    assert not first & second
    assert first | second == set(range(record.blocks))


def test_too_little_driving_is_refused() -> None:
    with pytest.raises(InputError, match=r"needs 6 for a budget|no stretch"):
        AnalysisRecord.of([log_of(seconds=15.0)])


@pytest.mark.slow
def test_what_counts_needs_a_second_of_it_before_for_the_noises_filter() -> None:
    """A car taken over every six seconds: blocks count, and none of their rows can be compared."""
    log = log_of(seconds=120.0)
    engaged = (log.time % 6.0) >= 0.05
    with pytest.raises(InputError, match=r"each behind 1 s that count; needs 6 for a budget"):
        AnalysisRecord.for_budget([replace(log, engaged=engaged)])
    found = diagnose(replace(log, engaged=engaged), effects=["dead_time"], pairs=False, posterior="laplace")
    assert found.budget is None
