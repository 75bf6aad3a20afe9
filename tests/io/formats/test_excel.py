"""Workbooks by other writers: xlsx by openpyxl, xls by xlwt, ods by odfpy."""

from __future__ import annotations

import datetime as dt
import io
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pytest
import xlwt
from odf.opendocument import OpenDocumentSpreadsheet
from odf.table import Table, TableCell, TableRow
from odf.text import P

from avtorch.errors import InputError
from avtorch.io.formats.excel import sheet_table

from .survival import open_here, refused, survives

Rows = Sequence[Sequence[Any]]
TIMES = [20.0 * i for i in range(30)]
SPEEDS = [50 + i / 8 for i in range(30)]
LOG: Rows = [
    ["Drive 7"],
    [],
    ["Time", "Speed", "Accel [m/s2]", "remark"],
    ["ms", "km/h", "", ""],
    *([t, v, -i / 16, "dry"] for i, (t, v) in enumerate(zip(TIMES, SPEEDS, strict=True))),
]


def xlsx(path: Path, sheets: dict[str, Rows]) -> Path:
    book = openpyxl.Workbook()
    book.remove(book.worksheets[0])
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
    book.save(path)
    book.close()
    return path


def xls(path: Path, sheets: dict[str, Rows]) -> Path:
    book = xlwt.Workbook()
    for name, rows in sheets.items():
        sheet = book.add_sheet(name)
        for i, row in enumerate(rows):
            for k, cell in enumerate(row):
                sheet.write(i, k, cell)
    book.save(str(path))
    return path


def ods(path: Path, sheets: dict[str, Rows]) -> Path:
    book = OpenDocumentSpreadsheet()
    for name, rows in sheets.items():
        table = Table(name=name)
        for row in rows:
            line = TableRow()
            for cell in row:
                if isinstance(cell, str):
                    made = TableCell(valuetype="string")
                    made.addElement(P(text=cell))
                else:
                    made = TableCell(valuetype="float", value=repr(float(cell)))
                line.addElement(made)
            table.addElement(line)
        book.spreadsheet.addElement(table)
    book.save(str(path))
    return path


WRITERS: dict[str, Callable[[Path, dict[str, Rows]], Path]] = {"xlsx": xlsx, "xls": xls, "ods": ods}


@pytest.mark.parametrize("form", WRITERS)
def test_the_first_sheet_with_a_table_is_read(tmp_path: Path, form: str) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}", {"notes": [["about the drive"]], "log": LOG})
    recording = open_here(path)
    assert recording.names == ("Speed", "Accel [m/s2]")
    assert dict(recording.units) == {"Speed": "km/h", "Accel [m/s2]": "m/s2"}
    assert recording.remarks == ("sheet 'log' is read, 1 others are not",)
    channels = recording.read(["Speed", "Accel [m/s2]"])
    assert channels["Speed"].values.tolist() == SPEEDS
    assert channels["Accel [m/s2]"].values.tolist() == [-i / 16 for i in range(30)]
    assert channels["Speed"].time.tolist() == [t * 1e-3 for t in TIMES]
    assert channels["Speed"].time is channels["Accel [m/s2]"].time


@pytest.mark.parametrize(("unit", "seconds"), [("min", 60.0), ("minutes", 60.0), ("hours", 3600.0)])
def test_times_in_a_unit_by_any_of_its_names_are_converted(tmp_path: Path, unit: str, seconds: float) -> None:
    """Minutes and hours in full were taken for seconds."""
    rows = [["Time", "Speed"], [unit, "m/s"], *([t / seconds, 20.0] for t in TIMES)]
    channels = open_here(xlsx(tmp_path / "drive.xlsx", {"a": rows})).read(["Speed"])
    np.testing.assert_allclose(channels["Speed"].time, TIMES)


def test_empty_cells_and_texts_are_nan_and_are_told(tmp_path: Path) -> None:
    rows = [["t", "speed", "accel"], [0.0, 1.0, 5.0], [0.1, None, "fast"], [None, 3.0, 7.0], [0.3, "4.5", 8.0]]
    recording = open_here(xlsx(tmp_path / "drive.xlsx", {"a": rows}))
    assert recording.names == ("speed", "accel")
    channels = recording.read(recording.names)
    assert channels["speed"].time.tolist() == [0.0, 0.1, 0.3]
    assert np.array_equal(channels["speed"].values, [1.0, np.nan, 4.5], equal_nan=True)
    assert np.array_equal(channels["accel"].values, [5.0, np.nan, 8.0], equal_nan=True)
    assert recording.remarks == (
        "1 cells hold a text where a number is expected; they are NaN",
        "1 rows without a time are left out",
    )


def test_columns_that_share_a_name_are_left_out(tmp_path: Path) -> None:
    rows = [["t", "x", "speed", "speed"], [0.0, 1.0, 5.0, 6.0], [0.1, 2.0, 7.0, 8.0]]
    recording = open_here(xlsx(tmp_path / "drive.xlsx", {"a": rows}))
    assert recording.names == ("x",)
    assert recording.remarks == ("columns that share a name are left out: speed",)


def test_dates_are_seconds(tmp_path: Path) -> None:
    start = dt.datetime(2026, 11, 23, 12, 0, 0)
    rows = [["Timestamp", "x"], *([start + dt.timedelta(milliseconds=500 * i), i] for i in range(4))]
    time = open_here(xlsx(tmp_path / "drive.xlsx", {"a": rows})).read(["x"])["x"].time
    begin = (start - dt.datetime(1970, 1, 1)).total_seconds()
    # a workbook counts days; milliseconds is what the reader of dates keeps of them
    assert np.abs(time - begin - 0.5 * np.arange(4)).max() <= 1e-3
    for cells, seconds in (
        ([dt.timedelta(seconds=1.5), 2.5], [1.5, 2.5]),
        ([dt.time(0, 0, 2), dt.time(0, 0, 3, 500_000)], [2.0, 3.5]),
        ([dt.date(1970, 1, 2), dt.datetime(1970, 1, 2, 0, 0, 1)], [86_400.0, 86_401.0]),
    ):
        found = sheet_table([["time", "x"], *([cell, 1] for cell in cells)], "drive.xlsx")
        assert found is not None
        assert found[1]["time"].values.tolist() == seconds


@pytest.mark.parametrize("rows", [[], [["time", "speed"]], [["time", "speed"], ["a", "b"]], [[1.0, 2.0], [3.0, 4.0]]])
def test_what_is_no_table(rows: Rows) -> None:
    assert sheet_table(rows, "drive.xlsx") is None


def test_a_sheet_without_names_or_without_a_time(tmp_path: Path) -> None:
    refused(xlsx(tmp_path / "a.xlsx", {"only": [[1.0, 2.0]]}), "no sheet has a row of names", "sheets: only")
    path = xlsx(tmp_path / "b.xlsx", {"a": [["speed", "accel"], [1.0, 2.0]]})
    refused(path, "no column is called time, t, timestamp", "columns: speed, accel")


def patched(path: Path, part: str, change: Callable[[bytes], bytes]) -> None:
    """The workbook with one of its parts changed."""
    out = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, change(old.read(name)) if name.endswith(part) else old.read(name))
    path.write_bytes(out.getvalue())


def test_more_cells_than_a_reader_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("avtorch.io.formats.listed.MOST_CELLS", 5)
    with pytest.raises(InputError, match="needs 5 at most"):
        sheet_table([["time", "speed"], [1.0, 2.0], [1.0, 2.0], [1.0, 2.0]], "drive.xlsx")


@pytest.mark.parametrize("form", WRITERS)
def test_damage_is_read_or_refused(tmp_path: Path, form: str, fresh_seed: int) -> None:
    path = WRITERS[form](tmp_path / f"drive.{form}", {"log": LOG})
    survives(path, path.read_bytes(), fresh_seed, cuts=8, flips=20)
