"""CSV and Parquet files as named columns of numbers, with errors that name the row and the column."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.opening import place, read_regular
from avtorch.io.size import MOST_BYTES, MOST_CELLS, MOST_COLUMNS
from avtorch.numeral import numeral

_MOST_CHARACTERS = 1_000_000  # of one row
_LINES_AHEAD = 100  # lines searched for a header that other lines precede

Wanted = Callable[[tuple[str, ...]], Collection[str]]
"""Selects the columns to read from the names of a file's columns."""


@dataclass(frozen=True)
class Table:
    """Named columns of one file, cells not yet parsed as numbers; None for a column that was not requested.

    Messages name rows as ``row 3 (line 4)``: the third row of data, and the line an editor shows. A Parquet file
    and arrays have no lines.
    """

    source: str
    names: tuple[str, ...]
    cells: tuple[Sequence[Any] | NDArray | None, ...]
    lines: Sequence[int] | None = None
    first: int = 0  # rows of the file before this part of it

    def __post_init__(self) -> None:
        object.__setattr__(self, "source", place(self.source))

    @property
    def rows(self) -> int:
        return next((len(cells) for cells in self.cells if cells is not None), 0)

    def where(self, row: int, column: str) -> str:
        """The place of a cell in words; ``row`` counts from 0."""
        line = f" (line {self.lines[row]})" if self.lines is not None else ""
        return f"{self.source}: row {self.first + row + 1}{line}, column {quoted(column)}"

    def numbers(self, column: str, *, empty_is_nan: bool = False) -> FloatArray:
        """A column as float64, ``(row,)``.

        Raises InputError naming row and column for an empty cell (unless ``empty_is_nan``), text, NaN and infinity.
        """
        count = self.names.count(column)
        if count != 1:
            what = "is missing" if count == 0 else f"occurs {count} times"
            raise InputError(f"{self.source}: column {quoted(column)} {what}; columns: {listed(self.names)}")
        cells = self.cells[self.names.index(column)]
        if cells is None:
            raise KeyError(f"column {column!r} was not among the wanted ones")
        if isinstance(cells, np.ndarray):
            values = np.asarray(cells, dtype=np.float64)
            empty = np.zeros(len(values), dtype=bool)
        else:
            values, empty = self._parse(cells, column, empty_is_nan)
        bad = ~np.isfinite(values) & ~empty
        if bad.any():
            row = int(np.argmax(bad))
            word = "NaN" if math.isnan(values[row]) else "infinite"
            raise InputError(f"{self.where(row, column)}: is {word}; a finite number is needed")
        return values

    def _parse(self, cells: Sequence[Any], column: str, empty_is_nan: bool) -> tuple[FloatArray, NDArray]:
        values = np.empty(len(cells))
        empty = np.zeros(len(cells), dtype=bool)
        for row, cell in enumerate(cells):
            try:
                values[row] = numeral(cell) if isinstance(cell, str) else _number(cell)
            except (TypeError, ValueError):
                if cell is None or (isinstance(cell, str) and not cell.strip()):
                    if empty_is_nan:
                        values[row], empty[row] = math.nan, True
                        continue
                    raise InputError(f"{self.where(row, column)}: is empty; a number is needed") from None
                raise InputError(f"{self.where(row, column)}: {_no_number(cell)}") from None
        return values, empty


def _number(cell: Any) -> float:
    """A cell that is not text: an integer may be too large, and bytes are text not yet decoded."""
    if isinstance(cell, (bytes, bytearray)):
        raise TypeError
    try:
        return float(cell)
    except OverflowError:
        return math.inf


def _no_number(cell: Any) -> str:
    if not isinstance(cell, str):
        return f"a {type(cell).__name__} is no number; a number is needed"
    hint = ""
    if cell.count(",") == 1 and cell.replace(",", "").lstrip("+-").isdigit():
        hint = " with a decimal point"
    return f"{quoted(cell, 30)} is no number; a number{hint} is needed"


def read_table(path: str | os.PathLike[str], *, header: str | None = None, wanted: Wanted | None = None) -> Table:
    """Read a CSV (UTF-8, comma) or Parquet file, of the columns only those that are `wanted` (default: all).

    ``header`` names the first cell of the header line where other lines come before it. Unnamed columns get the name
    ``(unnamed 1)`` by position. Lines end at ``\\n``, ``\\r\\n`` or ``\\r`` and nowhere else. Numbers are decimal, with
    ASCII digits and a point. Raises InputError for any other file: missing, not a regular file, empty, binary,
    another separator, no header, a row with too few or too many cells, and beyond 512 MiB, 10,000 columns, 1,000,000
    characters in a row, or 20 million cells in the wanted columns.
    """
    file = Path(path)
    raw = read_bytes(file)
    if raw[:4] == b"PAR1":
        from avtorch.io.parquet import read_parquet

        names, cells = read_parquet(raw, place(file), wanted)
        return Table(place(file), names, cells)
    if file.suffix.lower() in (".parquet", ".pq"):
        raise InputError(f"{place(file)}: named as Parquet but its content is not; write it anew, or name it .csv")
    return _csv(place(file), text_of(file, raw), header, wanted)


def read_bytes(file: Path) -> bytes:
    """The content of a file; InputError where there is none."""
    raw = read_regular(file, most=MOST_BYTES, need="a CSV or Parquet file")
    if not raw.strip():
        raise InputError(f"{place(file)}: is empty; a header line and rows are needed")
    return raw


def text_of(file: Path, raw: bytes) -> str:
    """UTF-8 text, with or without a byte order mark; InputError for anything else."""
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise InputError(f"{place(file)}: is UTF-16 text; UTF-8 is needed")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        # after a byte order mark the codec counts from behind it
        start = fault.start + (3 if raw.startswith(b"\xef\xbb\xbf") and len(fault.object) < len(raw) else 0)
        raise InputError(
            f"{place(file)}: line {_line(raw[:start])}, byte {start + 1}: is not UTF-8 text; "
            "a CSV or Parquet file is needed"
        ) from None
    if "\0" in text:
        line = _line(raw[: raw.index(b"\0")])
        raise InputError(
            f"{place(file)}: line {line}: holds a zero byte, so it is binary; a CSV or Parquet file is needed"
        )
    return text


def _line(before: bytes) -> int:
    return len(re.findall(rb"\r\n|\r|\n", before)) + 1


class _Lines:
    """Lines with their ends, split only at those; counts the characters of an incomplete row."""

    def __init__(self, source: str, text: str) -> None:
        self.source, self.open = source, 0
        self._lines = io.StringIO(text, newline="")

    def __iter__(self) -> Iterator[str]:
        for line in self._lines:
            self.open += len(line)
            if self.open > _MOST_CHARACTERS:
                raise InputError(
                    f"{self.source}: a row has more than {_MOST_CHARACTERS:,} characters; a CSV file is needed"
                )
            yield line


def _csv(source: str, text: str, header: str | None, wanted: Wanted | None) -> Table:
    rows = _rows(source, text)
    names, rows = _header(source, rows, header)
    chosen = set(names if wanted is None else wanted(names))
    kept = [i for i, name in enumerate(names) if name in chosen]
    columns: list[list[str]] = [[] for _ in kept]
    lines, blank = array("q"), array("q")
    wrong: tuple[int, int] | None = None  # cells and line of the first blank row of another width
    for row, line in rows:
        if (len(lines) + len(blank) + 1) * max(1, len(kept)) > MOST_CELLS:
            many = f"{MOST_CELLS // max(1, len(kept)):,} rows of {len(kept)} columns that are read"
            raise InputError(f"{source}: has more than {many}; split it")
        if not any(cell.strip() for cell in row):  # an editor leaves empty lines at the end; elsewhere they are wrong
            blank.append(line)
            wrong = wrong or ((len(row), line) if len(row) != len(names) else None)
            continue
        if wrong is not None or len(row) != len(names):
            cells, at = wrong or (len(row), line)
            number = len(lines) + (blank.index(at) if wrong else len(blank)) + 1
            found = f"has {cells} cells where the header has {len(names)}" if cells else "is empty"
            raise InputError(f"{source}: row {number} (line {at}): {found}")
        for i, column in zip(kept, columns, strict=True):
            if blank:
                column.extend([""] * len(blank))
            column.append(row[i])
        lines.extend(blank)
        lines.append(line)
        blank = array("q")
    read = dict(zip(kept, columns, strict=True))
    return Table(source, names, tuple(read.get(i) for i in range(len(names))), lines)


def _rows(source: str, text: str) -> Iterator[tuple[list[str], int]]:
    """Rows of cells, each with the number of its first line."""
    lines = _Lines(source, text)
    reader = csv.reader(lines, strict=True)
    first = 1
    while True:
        try:
            row = next(reader, None)
        except csv.Error as fault:
            raise InputError(f"{source}: line {first}: cannot be split into cells ({fault})") from None
        if row is None:
            return
        yield row, first
        first, lines.open = reader.line_num + 1, 0


def _header(
    source: str, rows: Iterator[tuple[list[str], int]], first_cell: str | None
) -> tuple[tuple[str, ...], Iterator[tuple[list[str], int]]]:
    """Names of the columns, and the rows of data below them."""
    ahead = list(islice(rows, 1 if first_cell is None else _LINES_AHEAD))
    if not ahead:
        raise InputError(f"{source}: is empty; a header line and rows are needed")
    start = next((i for i, (row, _) in enumerate(ahead) if row and row[0].strip() == first_cell), 0)
    head, line = ahead[start]
    if not any(cell.strip() for cell in head):
        raise InputError(f"{source}: line {line}: is empty; the header line with the column names is needed")
    if len(head) > MOST_COLUMNS:
        raise InputError(f"{source}: line {line}: has {len(head):,} columns; needs {MOST_COLUMNS:,} at most")
    _refuse_odd_header(source, head, line)
    names = tuple(cell if cell.strip() else f"(unnamed {i + 1})" for i, cell in enumerate(head))
    return names, chain(ahead[start + 1 :], rows)


def _refuse_odd_header(source: str, head: list[str], line: int) -> None:
    if re.match(r"\s*(\{|\[\s*[\[{\"0-9-])", head[0]):
        raise InputError(f"{source}: line {line}: looks like JSON; a CSV or Parquet file is needed")
    if len(head) == 1:
        for mark, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if mark in head[0]:
                raise InputError(f"{source}: line {line}: cells are separated by {word}; commas are needed")
        if len(head[0].split()) > 1:
            raise InputError(f"{source}: line {line}: cells are separated by spaces; commas are needed")
    if all(_is_number(name) for name in head):
        raise InputError(
            f"{source}: line {line}: holds numbers; the first line must be the header with the column names"
        )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
