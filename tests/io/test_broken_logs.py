"""Broken logs: each is refused, or its bad rows left out, in one line that states the place and the fault."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from avtorch.errors import InputError
from avtorch.io import Log, check

from .drives import drive, with_cell, write

GOOD = drive()
SPACED = GOOD | {"spacing": np.full(1500, 20.0), "lead_speed": GOOD["speed"]}


def refused(path: Path, *words: str, **options) -> str:
    with pytest.raises(InputError) as fault:
        Log.read(path, **options)
    said = str(fault.value)
    assert "\n" not in said
    assert said.startswith(str(path)) or "map" in said or "unit" in said or ".toml" in said
    for word in words:
        assert word in said, said
    return said


CELLS = {
    "text": ("accel", 17, "fast", "'fast' is no number"),
    "empty": ("speed", 3, "", "is empty"),
    "blank": ("speed", 3, "  ", "is empty"),
    "nan": ("accel_cmd", 40, "nan", "is NaN"),
    "inf": ("accel", 1500, "inf", "is infinite"),
    "unit_in_cell": ("speed", 2, "15 m/s", "'15 m/s' is no number"),
    "time_back": ("time", 100, 0.5, "goes back from 1.96 s to 0.5 s"),
    "time_repeats": ("time", 100, 1.96, "repeats 1.96 s"),
    "time_is_a_clock": ("time", 4, "12:00:01", "is no number"),
    "time_ahead": ("time", 100, 1e9, "jumps ahead to 1000000000 s"),
    "spike_accel": ("accel", 77, 60.0, "is 60; -50 to 50 m/s2 is needed"),
    "spike_speed": ("speed", 77, 151.0, "is 151; -2 to 150 m/s"),
    "reverse": ("speed", 77, -15.0, "is -15"),
    "spacing": ("spacing", 5, -0.5, "never negative"),
    "lead_speed": ("lead_speed", 5, -9.0, "is -9"),
}


@pytest.mark.parametrize("case", CELLS)
def test_a_bad_cell_costs_its_row_and_is_named_by_row_line_and_column(tmp_path, case):
    column, row, cell, what = CELLS[case]
    path = write(tmp_path / "lap.csv", with_cell(SPACED, column, row, cell))
    log = Log.read(path)
    assert log.rows == 1499
    assert np.array_equal(log.time, np.delete(GOOD["time"], row - 1))
    assert np.array_equal(log.speed, np.delete(GOOD["speed"], row - 1))
    assert len(log.remarks) == 1
    assert f"row {row} (line {row + 1}), column '{column}': " in log.remarks[0]
    assert what in log.remarks[0]
    assert log.remarks[0].endswith("; the row is left out")


@pytest.mark.parametrize("case", ["text", "inf", "time_repeats", "spike_speed"])
def test_more_than_a_twentieth_of_bad_cells_is_refused_at_the_first(tmp_path, case):
    column, row, cell, what = CELLS[case]
    columns = SPACED
    for at in range(row, row + 76) if row + 76 <= 1500 else range(row - 75, row + 1):
        columns = with_cell(columns, column, at, cell)
    path = write(tmp_path / "lap.csv", columns)
    refused(path, f"column '{column}'", what)


def test_several_bad_cells_are_counted(tmp_path):
    columns = SPACED
    for row in (5, 9, 40, 41, 300):
        columns = with_cell(columns, "speed", row, "n/a")
    log = Log.read(write(tmp_path / "lap.csv", with_cell(columns, "accel", 9, "n/a")))
    assert log.rows == 1495
    assert ["row 5 (line 6)" in log.remarks[0], "row 9" in log.remarks[1], "row 40" in log.remarks[2]] == [True] * 3
    assert log.remarks[3:] == ("2 more rows are left out for a cell that is no valid value",)
    assert any("n/a" in note for note in check(log).notes)


@pytest.mark.parametrize(
    ("signal", "value", "what"),
    [
        ("engaged", 2.0, "0 (driver) or 1 (engaged)"),
        ("engaged", "maybe", "'maybe' is no number"),
        ("segment", 0.5, "a whole number"),
        ("grade", 3.0, "--unit grade=%"),
        ("jerk", 1e5, "m/s3"),
        ("lead_accel", -99.0, "-50 to 50 m/s2"),
    ],
)
def test_a_bad_optional_signal(tmp_path, signal, value, what):
    columns = GOOD | {signal: [0.0] * 7 + [value] * 1493}
    refused(write(tmp_path / "lap.csv", columns), f"row 8 (line 9), column '{signal}'", what)


@pytest.mark.parametrize("column", ["time", "accel_cmd"])
def test_a_missing_column_is_named_with_a_way_out(tmp_path, column):
    path = write(tmp_path / "lap.csv", {column.upper() if k == column else k: v for k, v in GOOD.items()})
    refused(path, f"column '{column}' is missing", f"--map {column}=NAME", f"map={{'{column}': 'NAME'}}")
    assert len(Log.read(path, map={column: column.upper()}).time) > 0  # the advice works


def test_both_witnesses_missing(tmp_path):
    columns = {k: SPACED[k] for k in ("time", "accel_cmd", "lead_speed")}
    refused(write(tmp_path / "lap.csv", columns), "'accel' and 'speed' are both missing", "--map speed=NAME")


def test_a_following_log_may_lack_the_command_but_not_the_leader(tmp_path):
    columns = {k: v for k, v in SPACED.items() if k != "accel_cmd"}
    assert Log.read(write(tmp_path / "a.csv", columns), following=True).accel_cmd is None
    refused(tmp_path / "a.csv", "'accel_cmd' is missing")
    del columns["spacing"]
    refused(write(tmp_path / "b.csv", columns), "'spacing' is missing", following=True)


def test_a_doubled_column(tmp_path):
    path = write(tmp_path / "lap.csv", GOOD | {"x": GOOD["accel"]})
    text = path.read_text()
    path.write_text(text.replace("speed,x", "speed,accel", 1))
    refused(path, "column 'accel' occurs 2 times")


FILES = {
    "empty": (b"", "is empty"),
    "blank_lines": (b"\n\n  \n", "is empty"),
    "header_only": (b"time,accel_cmd,speed\n", "a header but no rows"),
    "one_row": (b"time,accel_cmd,speed\n0,1,2\n", "has one row"),
    "no_header": (b"0,1,2\n0.1,1,2\n0.2,1,2\n", "line 1: holds numbers"),
    "short_row": (b"time,accel_cmd,speed\n0,1,2\n0.1,1\n", "row 2 (line 3): has 2 cells where the header has 3"),
    "long_row": (b"time,accel_cmd,speed\n0,1,2,3\n0.1,1,2\n", "row 1 (line 2): has 4 cells"),
    "torn_quote": (b'time,accel_cmd,speed\n0,"1,2\n0.1,1,2\n', "cannot be split into cells"),
    "binary": (bytes(range(1, 256)) * 8, "is no text"),
    "zero_bytes": (b"time,accel_cmd,speed\n0,1,\0\n", "is no text"),
    "damaged_gzip": (b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03abc", "gzip data"),
    "torn_gzip": (gzip.compress(b"time,accel_cmd,speed\n0,1,2\n0.1,1,2\n")[:-12], "ends inside its gzip data"),
    "odd_utf16": ("time,speed\n0,1\n".encode("utf-16")[:-1], "is no text"),
    "torn_parquet": (b"PAR1" + b"\x00" * 100, "damaged Parquet"),
}


@pytest.mark.parametrize("case", FILES)
def test_a_bad_file(tmp_path, case):
    content, what = FILES[case]
    path = tmp_path / "lap.csv"
    path.write_bytes(content)
    refused(path, what)


def test_places_that_are_no_file(tmp_path):
    refused(tmp_path, "is a directory")
    refused(tmp_path / "absent.csv", "no such file")
    (tmp_path / "lap.parquet").write_text("time,accel_cmd,speed\n0,1,2\n")
    refused(tmp_path / "lap.parquet", "its content is not")


@pytest.mark.usefixtures("in_this_process")
def test_a_bad_parquet_cell_is_named_by_row(tmp_path):
    path = tmp_path / "lap.parquet"
    columns = {name: list(values) for name, values in GOOD.items()}
    columns["accel"][11] = None
    pq.write_table(pa.table(columns), path)
    (said,) = Log.read(path).remarks
    assert said == f"{path}: row 12, column 'accel': is empty; a number is needed; the row is left out"
    columns["accel"] = [str(x) for x in GOOD["accel"][:-1]] + ["fast"]
    pq.write_table(pa.table(columns), path)
    assert "row 1500, column 'accel': 'fast'" in Log.read(path).remarks[0]
    columns["accel"] = GOOD["accel"].copy()
    columns["accel"][5] = np.nan
    pq.write_table(pa.table(columns), path)
    assert "row 6, column 'accel': is NaN" in Log.read(path).remarks[0]
    columns["accel"] = [None] * 1500
    pq.write_table(pa.table(columns), path)
    refused(path, "row 1, column 'accel': is empty")


@pytest.mark.parametrize(
    ("scale", "what"), [(1e3, "--unit time=ms"), (1e6, "--unit time=us"), (1e9, "--unit time=ns"), (0.1, "500 Hz")]
)
def test_time_in_another_unit_and_rates_out_of_range(tmp_path, scale, what):
    path = write(tmp_path / "lap.csv", GOOD | {"time": GOOD["time"] * scale})
    refused(path, "column 'time'", "10 to 200 Hz", what)


@pytest.mark.parametrize(
    ("signals", "factor", "advice"),
    [
        (("speed",), 3.6, "--unit speed=km/h"),
        (("speed",), 3600 / 1609.344, "--unit speed=mph"),
        (("accel",), 1 / 9.80665, "--unit accel=g"),
        (("accel", "accel_cmd"), 1 / 9.80665, "--unit accel=g"),
        (("accel_cmd",), 1 / 9.80665, "--unit accel_cmd=g"),
        (("accel",), -1.0, "--unit accel=-1"),
        (("accel_cmd",), -1.0, "--unit accel_cmd=-1"),
        (("accel",), 100.0, "--unit accel=cm/s2"),
    ],
)
def test_a_unit_mistake_that_the_signals_prove(tmp_path, signals, factor, advice, fresh_seed):
    columns = drive(noise=0.02, seed=fresh_seed)
    # noise in the record's own unit is scaled with it; that is how a recorder errs
    columns = {name: values * factor if name in signals else values for name, values in columns.items()}
    refused(write(tmp_path / "lap.csv", columns), advice)
    # and what it advises mends it, applied to each signal that was off
    units = [f"{s}={advice.split('=', 1)[1]}" for s in signals]
    mended = Log.read(tmp_path / "lap.csv", unit=units)
    assert mended.rows == 1500


def test_km_per_hour_without_an_accelerometer(tmp_path):
    columns = {name: GOOD[name] for name in ("time", "accel_cmd", "speed")}
    columns["speed"] = columns["speed"] * 3.6
    refused(write(tmp_path / "lap.csv", columns), "--unit speed=km/h")


def test_leader_in_km_per_hour(tmp_path):
    refused(write(tmp_path / "lap.csv", SPACED | {"lead_speed": SPACED["lead_speed"] * 3.6}), "--unit lead_speed=km/h")


OPTIONS = {
    "map_form": ({"map": ["accel"]}, "SIGNAL=VALUE"),
    "map_signal": ({"map": ["acc=speed"]}, "'acc' is no signal"),
    "map_column": ({"map": {"accel": "CAN.ACC"}}, "column 'CAN.ACC' (accel) is missing"),
    "map_doubled": ({"map": ["accel=speed", "speed=speed"]}, "already mapped"),
    "map_twice": ({"map": ["accel=a", "accel=b"]}, "given as 'a' and as 'b'"),
    "unit_name": ({"unit": ["speed=furlongs"]}, "not known for speed"),
    "unit_kind": ({"unit": ["speed=g"]}, "not known for speed"),
    "unit_zero": ({"unit": ["speed=0"]}, "not known for speed"),
    "unit_nan": ({"unit": ["speed=nan"]}, "not known for speed"),
    "unit_signal": ({"unit": ["engaged=s"]}, "takes no unit"),
    "unit_absent": ({"unit": ["spacing=cm"]}, "the log has no column for spacing"),
    "stamp_time": ({"stamp": ["time=t2"]}, "time is the clock"),
    "stamp_column": ({"stamp": ["speed=t2"]}, "column 't2' (speed) is missing"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_a_bad_option(tmp_path, case):
    options, what = OPTIONS[case]
    path = write(tmp_path / "lap.csv", GOOD)
    with pytest.raises(InputError, match=re.escape(what)) as fault:
        Log.read(path, **options)
    assert "\n" not in str(fault.value)


def test_arrays_are_checked_as_files_are():
    def bad(what: str, **columns):
        with pytest.raises(InputError, match=re.escape(what)):
            Log.from_arrays(**(GOOD | columns))

    bad("'velocity' is no signal", velocity=GOOD["speed"])
    bad("signals differ in length", speed=GOOD["speed"][:-1])
    bad("has shape (1500, 1)", speed=GOOD["speed"][:, None])
    bad("arrays: row 1, column 'speed': 'a' is no number", speed=["a"] * 1500)
    bad("column 'speed': is NaN", speed=np.full(1500, np.nan))
    bad("row 2, column 'time': repeats", time=np.zeros(1500))
    bad("--unit speed=km/h", speed=GOOD["speed"] * 3.6)
