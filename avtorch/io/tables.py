"""CSV and Parquet files as named columns of numbers, with errors that name the row and the column."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError


@dataclass(frozen=True)
class Table:
    """Named columns of one file, cells not yet read as numbers.

    Rows are told to people as ``row 3 (line 4)``: the third row of data, and the line an editor shows. A Parquet file
    and arrays have no lines.
    """

    source: str
    names: tuple[str, ...]
    cells: tuple[Sequence[Any] | NDArray, ...]
    lines: Sequence[int] | None = None
    first: int = 0  # rows of the file before this part of it

    @property
    def rows(self) -> int:
        return len(self.cells[0]) if self.cells else 0

    def where(self, row: int, column: str) -> str:
        """The place of a cell in words; ``row`` counts from 0."""
        line = f" (line {self.lines[row]})" if self.lines is not None else ""
        return f"{self.source}: row {self.first + row + 1}{line}, column {column!r}"

    def numbers(self, column: str, *, empty_is_nan: bool = False) -> NDArray[np.float64]:
        """A column as float64, ``(row,)``.

        Raises InputError naming row and column for an empty cell (unless ``empty_is_nan``), text, NaN and infinity.
        """
        count = self.names.count(column)
        if count != 1:
            what = "is missing" if count == 0 else f"occurs {count} times"
            raise InputError(f"{self.source}: column {column!r} {what}; columns: {', '.join(self.names)}")
        cells = self.cells[self.names.index(column)]
        if isinstance(cells, np.ndarray):
            values = np.asarray(cells, dtype=np.float64)
            empty = np.zeros(len(values), dtype=bool)
        else:
            values, empty = self._parse(cells, column, empty_is_nan)
        bad = ~np.isfinite(values) & ~empty
        if bad.any():
            row = int(np.argmax(bad))
            found = values[row]
            word = "NaN" if math.isnan(found) else "infinite"
            raise InputError(f"{self.where(row, column)}: is {word}; a finite number is needed")
        return values

    def _parse(self, cells: Sequence[Any], column: str, empty_is_nan: bool) -> tuple[NDArray[np.float64], NDArray]:
        values = np.empty(len(cells))
        empty = np.zeros(len(cells), dtype=bool)
        for row, cell in enumerate(cells):
            try:
                values[row] = float(cell)
                # Python reads 1_000 as a number; no recorder writes that
                if isinstance(cell, str) and "_" in cell:
                    raise ValueError
            except (TypeError, ValueError):
                if cell is None or (isinstance(cell, str) and not cell.strip()):
                    if empty_is_nan:
                        values[row], empty[row] = math.nan, True
                        continue
                    raise InputError(f"{self.where(row, column)}: is empty; a number is needed") from None
                hint = ""
                if isinstance(cell, str) and cell.count(",") == 1 and cell.replace(",", "").lstrip("+-").isdigit():
                    hint = " with a decimal point"
                text = str(cell)
                shown = text if len(text) <= 30 else text[:27] + "..."
                place = self.where(row, column)
                raise InputError(f"{place}: {shown!r} is no number; a number{hint} is needed") from None
        return values, empty


def read_table(path: str | os.PathLike[str], *, header: str | None = None) -> Table:
    """Read a CSV (UTF-8, comma) or Parquet file.

    ``header`` names the first cell of the header line where other lines come before it. Unnamed columns get the name
    ``(unnamed 1)`` by position. Raises InputError for what is no such file: missing, a directory, empty, binary,
    another separator, no header, a row with too few or too many cells.
    """
    file = Path(path)
    raw = read_bytes(file)
    if raw[:4] == b"PAR1":
        return _parquet(file)
    if file.suffix.lower() in (".parquet", ".pq"):
        raise InputError(f"{file}: named as Parquet but its content is not; write it anew, or name it .csv")
    return _csv(file, text_of(file, raw), header)


def read_bytes(file: Path) -> bytes:
    """The content of a file; InputError where there is none."""
    if file.is_dir():
        raise InputError(f"{file}: is a directory; a CSV or Parquet file is needed")
    try:
        raw = file.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{file}: no such file") from None
    except (OSError, ValueError) as fault:
        raise InputError(f"{file}: cannot be read ({getattr(fault, 'strerror', None) or fault})") from None
    if not raw.strip():
        raise InputError(f"{file}: is empty; a header line and rows are needed")
    return raw


def text_of(file: Path, raw: bytes) -> str:
    """UTF-8 text, with or without a byte order mark; InputError for anything else."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{file}: is UTF-16 text; UTF-8 is needed")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        line = raw[: fault.start].count(b"\n") + 1
        raise InputError(
            f"{file}: line {line}, byte {fault.start + 1}: is not UTF-8 text; a CSV or Parquet file is needed"
        ) from None
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise InputError(f"{file}: line {line}: holds a zero byte, so it is binary; a CSV or Parquet file is needed")
    return text


def _csv(file: Path, text: str, header: str | None) -> Table:
    # splitlines would also break at form feeds and other rare characters; the csv module wants the line ends kept
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    rows: list[list[str]] = []
    lines: list[int] = []
    try:
        for row in reader:
            rows.append(row)
            lines.append(reader.line_num)
    except csv.Error as fault:
        raise InputError(f"{file}: line {reader.line_num}: cannot be split into cells ({fault})") from None
    while rows and not any(cell.strip() for cell in rows[-1]):  # an editor's empty lines at the end
        rows.pop()
        lines.pop()
    start = 0
    if header is not None:
        start = next((i for i, row in enumerate(rows) if row and row[0].strip() == header), 0)
    head = [cell if cell.strip() else f"(unnamed {i + 1})" for i, cell in enumerate(rows[start])]
    _refuse_odd_header(file, head, lines[start])
    rows, lines = rows[start + 1 :], lines[start + 1 :]
    for row, line in zip(rows, lines, strict=True):
        if len(row) != len(head):
            number = lines.index(line) + 1
            found = f"has {len(row)} cells where the header has {len(head)}" if row else "is empty"
            raise InputError(f"{file}: row {number} (line {line}): {found}")
    columns = tuple(zip(*rows, strict=True)) if rows else tuple(() for _ in head)
    return Table(str(file), tuple(head), columns, lines)


def _refuse_odd_header(file: Path, head: list[str], line: int) -> None:
    if len(head) == 1:
        for mark, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if mark in head[0]:
                raise InputError(f"{file}: line {line}: cells are separated by {word}; commas are needed")
        if len(head[0].split()) > 1:
            raise InputError(f"{file}: line {line}: cells are separated by spaces; commas are needed")
    if all(_is_number(name) for name in head):
        raise InputError(f"{file}: line {line}: holds numbers; the first line must be the header with the column names")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _parquet(file: Path) -> Table:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        data = pq.read_table(file)
    except (pa.ArrowException, OSError, ValueError) as fault:
        reason = str(fault).splitlines()[0] if str(fault) else type(fault).__name__
        raise InputError(f"{file}: damaged Parquet file ({reason})") from None
    cells: list[Sequence[Any] | NDArray] = []
    for column in data.columns:
        kind = column.type
        if pa.types.is_timestamp(kind) or pa.types.is_duration(kind):
            cells.append(_seconds(column))
        elif column.null_count == 0 and (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
            cells.append(np.asarray(column.to_numpy(), dtype=np.float64))
        else:  # text, booleans, decimals and empty cells go through the same careful reading as a CSV
            cells.append(column.to_pylist())
    return Table(str(file), tuple(data.column_names), tuple(cells))


def _seconds(column: Any) -> Sequence[Any]:
    """A Parquet time stamp brings its own unit: seconds since its epoch, the same for every column of the file."""
    import pyarrow as pa

    ticks = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}[column.type.unit]
    return [None if x is None else x / ticks for x in column.cast(pa.int64()).to_pylist()]
