"""Every row is scored once, far from the rows fitted."""

import numpy as np
import pytest

from avtorch.gap.blocks import folds
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.simulator.plant import plant
from avtorch.io import Log
from tests.gap.records import log_of


@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("seconds", [40.0, 130.0, 300.0])
def test_every_row_is_scored_once(seconds: float, rate_hz: int) -> None:
    record = Record.of(log_of(seconds=seconds, rate_hz=rate_hz))
    parts = folds(record, apart_s=3.0)
    judging = np.concatenate([p.rows for p in parts])
    np.testing.assert_array_equal(np.sort(judging), np.arange(record.rows))
    for part in parts:
        fits, held_out = record.time[part.fits.source], record.time[part.held_out.source]
        assert np.abs(fits[:, None] - held_out[None]).min() > 3.0
        assert all((b.stop - b.start) * record.dt > 9.9 for b in part.blocks)
        assert np.isin(part.held_out.source, record.source[part.rows]).all()


def test_drives_apart_need_no_distance() -> None:
    record = Record.of([log_of(seconds=14.0), log_of(seconds=14.0)])
    parts = folds(record)
    assert len(parts) == 2
    assert all(len(p.fits.source) == len(p.held_out.source) for p in parts)


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_of_three_drives_each_scores_the_fit_to_the_others(rate_hz: int) -> None:
    lengths = (70.0, 60.0, 50.0, 14.0, 13.0, 30.0)
    record = Record.of([log_of(seconds=s, rate_hz=rate_hz) for s in lengths])
    parts = folds(record)
    assert len(parts) == 5
    judging = np.concatenate([p.rows for p in parts])
    np.testing.assert_array_equal(np.sort(judging), np.arange(record.rows))
    ends = np.flatnonzero(np.diff(record.time) < 0) + 1
    drive = np.searchsorted(ends, np.arange(len(record.time)), side="right")
    for part in parts:
        assert not set(drive[part.held_out.source]) & set(drive[part.fits.source])
        assert set(drive[part.held_out.source]) | set(drive[part.fits.source]) == set(range(6))


def test_one_long_drive_beside_short_ones_is_cut_into_blocks() -> None:
    record = Record.of([log_of(seconds=120.0), log_of(seconds=14.0), log_of(seconds=14.0)])
    assert len(folds(record)) == 5


def test_too_short_to_be_parted() -> None:
    assert folds(Record.of(log_of(seconds=17.0))) == ()


def test_rollouts_are_the_same_where_fewer_rows_count() -> None:
    log = log_of(seconds=60.0, rate_hz=100)
    stop = (log.time > 20) & (log.time < 24)
    engaged = np.where(stop, 0.0, 1.0)
    held = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=log.accel, speed=log.speed, engaged=engaged)
    record = Record.of([held, log])
    keep = np.zeros(record.rows, bool)
    keep[100:400] = keep[900:1000] = keep[1100:1120] = keep[1200:] = True
    fewer = record.only(keep)
    # 20 rows are one second: too short a stretch
    keep[1100:1120] = False
    np.testing.assert_array_equal(fewer.source, record.source[keep])
    z = np.array([[0.2, -0.3]])
    all_, some = (Hypothesis(r, (), plant()).errors(z, coarse=coarse) for r in (record, fewer) for coarse in (False,))
    np.testing.assert_array_equal(some, all_[:, :, keep])
    # where a stretch is cut, another begins
    whole = np.split(np.arange(record.rows)[keep], np.flatnonzero(np.diff(np.flatnonzero(keep)) > 1) + 1)
    assert len(fewer.starts) >= len(whole)
