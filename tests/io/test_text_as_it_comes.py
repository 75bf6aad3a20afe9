"""One drive, written as recorders and spreadsheets write it: every form reads to the same numbers."""

from __future__ import annotations

import gzip
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.text import decoded, layout_of, seconds_of

from .drives import drive

DRIVE = drive(seconds=3.0)
NAMES = tuple(DRIVE)
UNITS = ("s", "m/s²", "m/s^2", "m/s")


def text(
    separator: str = ",", decimal: str = ".", comments: bool = False, units: bool = False, preamble: bool = False,
    end: str = "\n", marked: bool = False, note: bool = False,
) -> str:  # fmt: skip
    """The drive to six decimals; `note`: a column of words besides."""
    lines = ["Recorder 3.2", "serial number 17"] if preamble else []
    lines += ["# recorded in the rain; twice", "# by hand, mostly"] if comments else []
    head = [*NAMES, *(["note"] if note else [])]
    lines.append(("# " if marked else "") + separator.join(head))
    if units:
        lines.append(separator.join([*UNITS, *(["-"] if note else [])]))
    for number, row in enumerate(zip(*DRIVE.values(), strict=True)):
        cells = [f"{x:.6f}".replace(".", decimal) for x in row]
        lines.append(separator.join([*cells, *(["dry", "wet"][number % 2 : number % 2 + 1] if note else [])]))
        if comments and number == 30:
            lines.append("# here it stopped raining")
    return end.join(lines) + end


def same(path: Path) -> Log:
    log = Log.read(path)
    for name, values in DRIVE.items():
        assert np.array_equal(getattr(log, name), np.round(values, 6)), name
    return log


LAYOUTS = [
    (separator, decimal)
    for separator in (",", ";", "\t", "|", " ")
    for decimal in (".", ",")
    if not (separator == "," and decimal == ",")
]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    layout=st.sampled_from(LAYOUTS),
    comments=st.booleans(),
    units=st.booleans(),
    preamble=st.booleans(),
    note=st.booleans(),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "utf-16", "cp1252"]),
    zipped=st.booleans(),
)
def test_any_layout_reads_to_the_same_numbers(tmp_path, layout, comments, units, preamble, note, end, encoding, zipped):
    written = text(*layout, comments=comments, units=units, preamble=preamble, note=note, end=end).encode(encoding)
    path = tmp_path / ("lap.csv.gz" if zipped else "lap.csv")
    path.write_bytes(gzip.compress(written) if zipped else written)
    log = same(path)
    told = any("read as Windows-1252" in remark for remark in log.remarks)
    assert told == (encoding == "cp1252" and units)  # the squared sign is the only letter beyond ASCII


def test_a_header_behind_the_mark_of_a_comment(tmp_path):
    """numpy.savetxt writes it so, and `rostopic echo -p` with a per cent sign."""
    for mark in ("# ", "%", "#"):
        (tmp_path / "lap.txt").write_text(text(marked=True).replace("# ", mark, 1))
        same(tmp_path / "lap.txt")


def test_decimal_commas_in_quotation_marks(tmp_path):
    rows = [",".join(f'"{x:.6f}"'.replace(".", ",") for x in row) for row in zip(*DRIVE.values(), strict=True)]
    (tmp_path / "lap.csv").write_text("\n".join([",".join(NAMES), *rows]))
    same(tmp_path / "lap.csv")


def test_cells_padded_to_columns(tmp_path):
    rows = ["  ".join(f"{x:14.6f}" for x in row) + "  " for row in zip(*DRIVE.values(), strict=True)]
    (tmp_path / "lap.txt").write_text("\n".join(["  ".join(f"{n:>14}" for n in NAMES), *rows]))
    same(tmp_path / "lap.txt")


def test_empty_lines_and_a_torn_last_row(tmp_path):
    lines = text().splitlines()
    torn = "\n".join([*lines[:20], "", "  ", *lines[20:-1], lines[-1][:9]])
    (tmp_path / "lap.csv").write_text(torn)
    log = Log.read(tmp_path / "lap.csv")
    assert log.rows == len(DRIVE["time"]) - 1
    (said,) = log.remarks
    assert "row 150 (line 153): has 2 cells where the header has 4; the row is left out" in said


def test_states_as_words(tmp_path):
    lines = text().splitlines()
    states = ["engaged", *("True" if i > 10 else "false" for i in range(len(lines) - 1))]
    (tmp_path / "lap.csv").write_text("\n".join(f"{a},{b}" for a, b in zip(lines, states, strict=True)))
    assert Log.read(tmp_path / "lap.csv").engaged.tolist() == [i > 10 for i in range(len(lines) - 1)]


START = datetime(2024, 3, 31, 0, 59, 58, tzinfo=UTC)


def stamped(tmp_path: Path, form) -> Log:
    lines = text().splitlines()
    times = [form(START + timedelta(seconds=round(t, 6))) for t in DRIVE["time"]]
    rows = [f'"{t}",{line.split(",", 1)[1]}' for t, line in zip(times, lines[1:], strict=True)]
    (tmp_path / "lap.csv").write_text("\n".join([lines[0], *rows]))
    return Log.read(tmp_path / "lap.csv")


@pytest.mark.parametrize(
    "form",
    [
        lambda t: t.isoformat(),
        lambda t: t.strftime("%Y-%m-%dT%H:%M:%S.%fZ"),
        lambda t: t.strftime("%Y-%m-%d %H:%M:%S.%f"),
        lambda t: t.strftime("%Y-%m-%d %H:%M:%S,%f UTC"),
        lambda t: (t + timedelta(hours=5.5)).strftime("%Y-%m-%dT%H:%M:%S.%f+05:30"),
        lambda t: (t - timedelta(hours=8)).strftime("%Y-%m-%dT%H:%M:%S.%f-0800"),
    ],
)
def test_dates_are_seconds_since_1970(tmp_path, form):
    log = stamped(tmp_path, form)
    assert log.epoch_s == START.timestamp()
    # both are rounded where float64 counts seconds since 1970
    assert np.allclose(log.elapsed, DRIVE["time"], atol=1e-6, rtol=0)
    assert log.remarks == ()


def test_a_clock_of_hours_goes_on_after_midnight(tmp_path):
    log = stamped(tmp_path, lambda t: (t + timedelta(hours=22, minutes=59, seconds=59.5)).strftime("%H:%M:%S.%f"))
    assert np.allclose(log.elapsed, DRIVE["time"], atol=1e-9, rtol=0)
    assert log.time[0] == 23 * 3600 + 59 * 60 + 57.5


@pytest.mark.parametrize("cell", ["2024-13-01 10:00:00", "25:00:00", "10:61:00", "2024-02-30 01:00:00"])
def test_times_that_do_not_exist(cell):
    assert np.isnan(seconds_of([cell])).all()


def test_a_bad_time_costs_its_row(tmp_path):
    lines = text().splitlines()
    for i in range(1, len(lines)):
        lines[i] = f"10:00:{DRIVE['time'][i - 1]:09.6f}" + lines[i][lines[i].index(",") :]
    lines[7] = "later" + lines[7][lines[7].index(",") :]
    (tmp_path / "lap.csv").write_text("\n".join(lines))
    (said,) = Log.read(tmp_path / "lap.csv").remarks
    assert "row 7 (line 8), column 'time': 'later' is no time" in said


def test_the_layout_is_found_in_what_is_there():
    assert layout_of([]).separator == ","
    assert layout_of(["a\n", "1\n"]).header == 1
    found = layout_of(["# x\n", "\n", "a;b\n", "s;m\n", "1,5;2\n"])
    assert (found.separator, found.decimal, found.header, found.units) == (";", ",", 3, True)


def test_a_bomb_stops_at_the_limit(monkeypatch):
    from avtorch.io import text as encoding

    monkeypatch.setattr(encoding, "MOST_BYTES", 10_000)
    with pytest.raises(InputError, match="holds over 10,000 bytes"):
        encoding.unzipped("lap.gz", gzip.compress(bytes(10**7)))


def test_several_gzip_members_are_one_file():
    from avtorch.io.text import unzipped

    assert unzipped("lap.gz", gzip.compress(b"time,") + gzip.compress(b"speed")) == b"time,speed"
    assert decoded("lap.csv", b"\xef\xbb\xbfa")[0] == "a"
