"""Time from the log's start, and the clock it began on, for people."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avtorch.cli import main
from avtorch.errors import InputError
from avtorch.io import Log, check
from avtorch.io.clock import clock_words, decimals, from_start, since, since_start, time_label
from avtorch.vehicle import GLVDPlant, Leader, simulate

UNIX_S = 1_700_000_000.123


@given(
    st.lists(st.integers(5_000, 100_000), min_size=1, max_size=50),
    st.integers(-(10**15), 4 * 10**15),
)
def test_microseconds_survive_any_epoch(steps: list[int], first: int) -> None:
    """A recorder's stamps in whole microseconds, read as the nearest float64 [s]: their differences come back exactly.

    From 4.3e9 s on, the year 2106, a float64 no longer resolves microseconds.
    """
    ticks = np.cumsum([0, *steps])
    stamps = np.array([(first + int(tick)) / 1_000_000 for tick in ticks])
    told = since(stamps, float(stamps[0]))
    assert told.tolist() == [int(tick) / 1_000_000 for tick in ticks]


def test_decimals_are_those_that_stamps_of_this_size_resolve() -> None:
    assert decimals(1.7e9) == 6  # steps of 2.4e-7 s
    assert decimals(1e5) == 10
    assert decimals(0.0) == decimals(60.0) == 12


def test_stamps_closer_than_the_decimals_resolve_stay_apart() -> None:
    stamps = 1.7e9 + np.array([0.0, 2.4e-7, 1.0])
    assert (np.diff(since(stamps, 1.7e9)) > 0).all()


def test_even_rows_become_even_and_jitter_stays() -> None:
    ticks = np.delete(np.arange(3000), [700, 701, 2500])
    near, far = (since_start(ticks / 30 + epoch, np.zeros(len(ticks), np.int64)) for epoch in (0.0, UNIX_S))
    np.testing.assert_allclose(far, near, atol=1e-6)
    steps = np.diff(far)[:600]
    assert np.ptp(steps) < 1e-9
    jitter = np.random.default_rng(0).uniform(-2e-3, 2e-3, 3000)
    time = np.round(np.arange(3000) / 100 + jitter, 6)
    late = since_start(time + UNIX_S, np.zeros(3000, np.int64))
    np.testing.assert_array_equal(late, np.round(time - time[0], 6))


def test_a_clock_is_said_with_its_date_where_it_may_be_unix_time() -> None:
    assert clock_words(UNIX_S) == "1700000000.123 s, as Unix time 2023-11-14 22:13:20 UTC"
    assert clock_words(12.5) == "12.5 s"
    assert clock_words(-5e8) == "-500000000 s"
    assert time_label(0.0) == "time [s]"
    assert "2023-11-14" in time_label(UNIX_S)


def test_windows_are_counted_from_the_start() -> None:
    windows = [{"start_s": UNIX_S + 2.0, "end_s": UNIX_S + 4.0, "n": 200}]
    assert from_start(windows, UNIX_S) == [{"start_s": 2.0, "end_s": 4.0, "n": 200}]
    assert windows[0]["end_s"] == UNIX_S + 4.0


@pytest.fixture
def unix_drive(tmp_path: Path) -> Path:
    run = simulate(Leader.default(duration=15.0), plant=GLVDPlant(0.3, 1.0, sigma=0.1), duration=14.0, seeds=[1])
    log = run.log()
    columns = {name: getattr(log, name) for name in ("accel_cmd", "accel", "speed", "jerk")}
    rows = np.r_[0:700, 900 : log.rows]
    cut = {name: x[rows] for name, x in columns.items() if x is not None}
    path = tmp_path / "unix.csv"
    Log.from_arrays(time=log.time[rows] + UNIX_S, **cut).write(path)
    return path


def test_quality_notes_count_from_the_start_and_name_the_epoch(unix_drive: Path) -> None:
    seen = check(Log.read(unix_drive))
    assert f"times are shown from the log's start, at {clock_words(UNIX_S)}" in seen.notes
    assert "gap of 2.01 s after row 700 (6.99 s from the start): a new segment starts" in seen.notes
    assert seen.epoch_s == UNIX_S
    assert seen.gaps[0].start_s == pytest.approx(UNIX_S + 6.99, abs=1e-6)


def test_a_faulty_row_is_named_by_all_digits_of_its_stamp(unix_drive: Path) -> None:
    log = Log.read(unix_drive)
    time = log.time.copy()
    time[5] = time[4]
    (said,) = Log.from_arrays(time=time, accel_cmd=log.accel_cmd, accel=log.accel).remarks
    assert "row 6, column 'time': repeats 1700000000.163 s" in said


@pytest.mark.slow
def test_estimates_are_listed_from_the_start_and_kept_on_the_clock(
    unix_drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["estimate", str(unix_drive), "--estimator", "map", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "as Unix time 2023-11-14 22:13:20 UTC" in " ".join(told.split())
    assert {"0 to 2", "6 to 7", "9 to 11"} <= set(re.findall(r"^(\d+ to \d+) ", told, re.MULTILINE))
    assert "1700000002" not in told
    answer = json.loads((out / "estimates.json").read_text(encoding="utf-8"))
    assert answer["epoch_s"] == UNIX_S
    assert answer["windows"][0]["start_s"] == pytest.approx(UNIX_S, abs=1e-6)
    assert answer["windows"][1]["end_s"] == pytest.approx(UNIX_S + 4.0, abs=1e-6)


@pytest.mark.parametrize("first", [-(2.0**49)])
def test_a_first_stamp_too_large_to_resolve_rows_is_refused(first: float) -> None:
    """Found by the fuzzer: all steps after it are less than what float64 resolves there."""
    time = np.arange(200) / 20.0
    time[0] = first
    with pytest.raises(InputError, match=r"^arrays: (row 1, )?column 'time': found .* so far from"):
        Log.from_arrays(time=time, accel_cmd=np.sin(time), accel=np.sin(time - 0.2))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("row", "stamp"), [(199, 1e308), (0, -1e308), (0, -1e300), (100, 1e25)])
def test_a_stamp_beyond_any_clock_costs_its_row(row: int, stamp: float) -> None:
    """The first was found by the fuzzer as an overflow."""
    time = np.arange(200) / 20.0
    time[row] = stamp
    log = Log.from_arrays(time=time, accel_cmd=np.sin(time), accel=np.sin(time - 0.2))
    assert log.rows == 199
    assert re.search(rf"row {row + 1}, column 'time': found .* needs stamps within", log.remarks[0])


@pytest.mark.filterwarnings("error")
def test_steps_too_small_to_count_a_jump_in_are_refused_as_a_rate() -> None:
    time = np.arange(200) * 1e-300
    time[-1] = 1e20
    with pytest.raises(InputError, match="rows come at"):
        Log.from_arrays(time=time, accel_cmd=np.sin(time), accel=np.sin(time))
