"""How a table is written: its separator, its decimal mark, and which lines are comments, header and units.

A log is a table of numbers, so the separator is the one that makes numbers and times of its cells. clevercsv, which
judges tables of any content, takes the comma where spaces separate decimal commas, and a second to be imported.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from avtorch.errors import InputError
from avtorch.io.text.time_stamps import is_time
from avtorch.numeral import numeral

COMMENT = ("#", "//", "%")
"""What a line of comment begins with."""
SEPARATORS = (",", ";", "\t", "|", " ")
"""What may stand between cells; a space, any number of them."""
_LINES, _SAMPLE = 100, 20_000  # lines and characters that are looked at
_COMMA_NUMBER = re.compile(r"\s*[+-]?\d*,\d+([eE][+-]?\d+)?\s*")
_POINT_NUMBER = re.compile(r"\s*[+-]?\d*\.\d*([eE][+-]?\d+)?\s*")


@dataclass(frozen=True)
class Layout:
    """`separator` of cells (a space stands for any number of them), `decimal` mark, `header` line (from 1), `marked`:
    the header stands behind a comment's mark; `units`: a row of them follows."""

    separator: str = ","
    decimal: str = "."
    header: int = 1
    marked: str = ""
    units: bool = False

    @property
    def words(self) -> str:
        """The layout in words."""
        words = [f"cells separated by {_MARKS[self.separator]}"]
        words += ["decimal commas"] if self.decimal == "," else []
        words += [f"header in line {self.header}"] if self.header > 1 else []
        words += ["a row of units"] if self.units else []
        return ", ".join(words)


_MARKS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of one line; of a line whose quotation does not end, what a plain split gives."""
    line = line.rstrip("\r\n")
    try:
        if separator == " ":
            return next(csv.reader([line.strip()], delimiter=" ", skipinitialspace=True, strict=True), [])
        return next(csv.reader([line], delimiter=separator, strict=True), [])
    except csv.Error:
        return line.split(separator)


def layout_of(lines: Iterable[str]) -> Layout:
    """The layout of a table by its first lines, with their ends."""
    head = _head(lines)
    plain = [(number, line) for number, line in head if line.strip() and not is_comment(line)]
    separator = _separator([line for _, line in plain])
    rows = [(number, cells_of(line, separator)) for number, line in plain]
    number, marked = _header(head, rows, separator)
    below = [cells for at, cells in rows if at > number]
    width = len(cells_of(dict(head)[number].lstrip()[len(marked) :], separator)) if head else 0
    return Layout(separator, _decimal(below), number, marked, _are_units(below, width))


def _head(lines: Iterable[str]) -> list[tuple[int, str]]:
    """The first lines with their numbers; one whose quotation goes on over the next is one with these."""
    head: list[tuple[int, str]] = []
    size, quoted = 0, False
    for number, line in enumerate(lines, 1):
        if quoted:
            head[-1] = (head[-1][0], head[-1][1] + line)
        else:
            head.append((number, line))
        quoted ^= line.count('"') % 2 == 1
        size += len(line)
        if number >= _LINES or size > _SAMPLE:
            break
    return head


def is_comment(line: str) -> bool:
    return line.lstrip().startswith(COMMENT)


def _separator(lines: Sequence[str]) -> str:
    """The separator that makes most of the cells of most rows values; a comma where none makes any."""
    return max(SEPARATORS, key=lambda separator: _made(lines, separator))


def _made(lines: Sequence[str], separator: str) -> float:
    """Share of the rows that are as wide as most with data, times the share of values among the cells of these."""
    rows = [cells_of(line, separator) for line in lines]
    widths = Counter(len(row) for row in rows if _has_data(row) and len(row) > 1)
    if not widths:
        return 0.0
    width = widths.most_common(1)[0][0]
    cells = [cell for row in rows if len(row) == width and _has_data(row) for cell in row]
    return sum(len(row) == width for row in rows) / len(rows) * sum(map(_is_value, cells)) / len(cells)


def _header(head: Sequence[tuple[int, str]], rows: Sequence[tuple[int, list[str]]], separator: str) -> tuple[int, str]:
    """Number of the header's line and, where that is a comment, the mark before it.

    Lines before it have other widths than the rows of data; a header behind a comment's mark is the last comment before
    the data, as wide as they are.
    """
    first = rows[0][0] if rows else 1
    widths = Counter(len(cells) for _, cells in rows if _has_data(cells))
    if not widths:
        return first, ""
    usual = widths.most_common(1)[0][0]
    number, cells = next((number, cells) for number, cells in rows if len(cells) == usual and _has_data(cells))
    names = [(at, row) for at, row in rows if at < number and len(row) == len(cells) and not _has_data(row)]
    if names:
        # a spreadsheet pads the lines before the header with empty cells
        filled = [sum(bool(cell.strip()) for cell in row) for _, row in names]
        return names[filled.index(max(filled))][0], ""
    for at, line in reversed([(at, line.strip()) for at, line in head if at < number and line.strip()]):
        mark = next((mark for mark in COMMENT if line.startswith(mark)), None)
        if mark is not None and number == first:
            named = cells_of(line[len(mark) :], separator)
            if len(named) == len(cells) > 1 and not _has_data(named):
                return at, mark
            break
    return first, ""


def _are_units(below: Sequence[Sequence[str]], width: int) -> bool:
    """Whether the row below a header of `width` names units: texts, or the 1 of a bare number, above values."""
    if len(below) < 2 or len(below[0]) != width or not _has_data(below[1]):
        return False
    texts = [cell for cell in below[0] if cell.strip() and cell.strip() != "1"]
    return bool(texts) and not _has_data(texts)


def _has_data(cells: Sequence[str]) -> bool:
    return any(_is_value(cell) for cell in cells)


def _is_value(cell: str) -> bool:
    if _COMMA_NUMBER.fullmatch(cell) or is_time(cell):
        return True
    try:
        numeral(cell)
    except ValueError:
        return False
    return True


def _decimal(rows: Sequence[Sequence[str]]) -> str:
    cells = [cell for row in rows for cell in row]
    commas = sum(_COMMA_NUMBER.fullmatch(cell) is not None for cell in cells)
    points = sum(_POINT_NUMBER.fullmatch(cell) is not None for cell in cells)
    return "," if commas > points else "."


_MOST_CHARACTERS = 1_000_000  # of one row


def rows_of(source: str, text: str, layout: Layout) -> Iterator[tuple[list[str], int]]:
    """The header, then all that follows but comments and rows without any cell filled at the end.

    Raises InputError for a quotation that does not end, and for a row of over 1,000,000 characters.
    """
    lines = _Lines(source, text, layout)
    spaced = layout.separator == " "
    reader = csv.reader(lines, delimiter=layout.separator, skipinitialspace=spaced, strict=True)
    blank: list[tuple[list[str], int]] = []
    while True:
        lines.open = 0
        try:
            row = next(reader, None)
        except csv.Error as fault:
            raise InputError(f"{source}: line {lines.first}: cannot be split into cells ({fault})") from None
        if row is None:
            return
        if not row or (len(row) == 1 and not row[0].strip()):  # nothing but a line's end
            continue
        if not any(cell.strip() for cell in row):  # spreadsheets leave such rows at the end
            blank.append((row, lines.first))
            continue
        yield from blank
        blank.clear()
        yield row, lines.first


class _Lines:
    """Lines with their ends, split only at those, from the header on and without comments.

    `open` counts the characters of a row that is not complete, `first` is the number of its first line.
    """

    def __init__(self, source: str, text: str, layout: Layout) -> None:
        self.source, self.layout = source, layout
        self.open = self.first = 0
        self._lines = io.StringIO(text, newline="")

    def __iter__(self) -> Iterator[str]:
        for number, line in enumerate(self._lines, 1):
            if number < self.layout.header:
                continue
            if number == self.layout.header:
                line = line.lstrip()[len(self.layout.marked) :].lstrip(" ") if self.layout.marked else line
            elif not self.open and is_comment(line):
                continue
            if not self.open:
                self.first = number
            self.open += len(line)
            if self.open > _MOST_CHARACTERS:
                raise InputError(
                    f"{self.source}: a row has more than {_MOST_CHARACTERS:,} characters; a CSV file is needed"
                )
            # trailing spaces would be one more cell
            yield line.rstrip(" \t\r\n") + "\n" if self.layout.separator == " " and self.open == len(line) else line
