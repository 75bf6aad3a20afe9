"""Text tables as recorders and spreadsheets write them: encoding, separator, decimal mark, comments, header and units,
and times such as `2024-09-16T10:02:28.125+02:00`.

A log is a table of numbers, so the separator is the one that makes numbers and times of its cells. clevercsv, which
judges tables of any content, takes the comma where spaces separate decimal commas, and a second to be imported.

A statistical guess at the code page does worse than a fixed one: charset-normalizer 3.5 named seven of ten headers with
m/s², ° or an umlaut wrongly. So text that is not Unicode is read as Windows-1252, and that is told.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io.opening import MOST_BYTES
from avtorch.numeral import numeral

_DAY_S = 86_400.0
_STAMP = re.compile(
    r"\s*(?:(?P<day>\d{4}-\d\d-\d\d)[T\s]+)?(?P<clock>\d\d:\d\d:\d\d)(?:[.,](?P<fraction>\d{1,12}))?"
    r"\s*(?P<zone>Z|UTC|GMT|[+-]\d\d:?\d\d)?\s*"
)
_TEXT = 100  # characters of the longest


def is_time(cell: str) -> bool:
    """Whether a cell is a time of day, with or without a date."""
    return len(cell) <= _TEXT and _STAMP.fullmatch(cell) is not None


def seconds_of(cells: Sequence[str]) -> FloatArray:
    """Seconds (cell,) of times as text, NaN where a cell is none.

    With an ISO date they count from 1970, in UTC where an offset is stated; without one from midnight, and go on
    counting over the next.
    """
    out, dated = np.full(len(cells), np.nan), False
    for row, cell in enumerate(cells):
        stamp = _STAMP.fullmatch(cell) if len(cell) <= _TEXT else None
        if stamp is None:
            continue
        dated |= stamp["day"] is not None
        zone = "Z" if stamp["zone"] in (None, "UTC", "GMT") else stamp["zone"]
        try:
            moment = datetime.fromisoformat(f"{stamp['day'] or '1970-01-01'}T{stamp['clock']}{zone}")
        except ValueError:  # a time that does not exist
            continue
        out[row] = moment.timestamp() + float(f"0.{stamp['fraction'] or 0}")
    if not dated:  # a clock of hours begins anew
        known = np.flatnonzero(np.isfinite(out))
        out[known[1:]] += _DAY_S * np.cumsum(np.diff(out[known]) < -_DAY_S / 2)
    return out


_BINARY = re.compile(rb"[\x00-\x08\x0b\x0e-\x1a\x1c-\x1f]")


def unzipped(source: str, raw: bytes) -> bytes:
    """`raw`, or what it holds if it is gzip. Raises InputError for a damaged one, and beyond `MOST_BYTES`."""
    if not raw.startswith(b"\x1f\x8b"):
        return raw
    try:
        with gzip.open(io.BytesIO(raw)) as stream:
            content = stream.read(MOST_BYTES + 1)
    except EOFError:
        raise InputError(f"{source}: ends inside its gzip data; the whole file is needed") from None
    except (OSError, zlib.error):
        raise InputError(f"{source}: damaged gzip data; write the file anew") from None
    if len(content) > MOST_BYTES:
        raise InputError(f"{source}: holds over {MOST_BYTES:,} bytes; {MOST_BYTES:,} at most are needed")
    return content


def decoded(source: str, raw: bytes) -> tuple[str, tuple[str, ...]]:
    """Text, and a remark on its encoding where that had to be guessed. Raises InputError for what is no text."""
    guess = "the text is not UTF-8: it is read as Windows-1252 (Latin-1)"
    wide = raw.startswith((b"\xff\xfe", b"\xfe\xff"))
    for code in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        with suppress(UnicodeDecodeError):
            text = raw.decode(code)
            if "\0" not in text and (code != "cp1252" or _BINARY.search(raw) is None):
                return text, (guess,) if code == "cp1252" else ()
    raise InputError(f"{source}: is no text; a CSV or Parquet file is needed")


COMMENT = ("#", "//", "%")
"""What a line of comment begins with."""
SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", " ": "spaces"}
"""What may stand between cells, and its name; of spaces any number."""
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
        words = [f"cells separated by {SEPARATORS[self.separator]}"]
        words += ["decimal commas"] if self.decimal == "," else []
        words += [f"header in line {self.header}"] if self.header > 1 else []
        words += ["a row of units"] if self.units else []
        return ", ".join(words)


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of one line; of a line whose quotation does not end, what a plain split gives."""
    line, spaced = line.rstrip("\r\n"), separator == " "
    whole = line.strip() if spaced else line
    try:
        return next(csv.reader([whole], delimiter=separator, skipinitialspace=spaced, strict=True), [])
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
    return sum(len(row) == width for row in rows) / len(rows) * sum(map(is_value, cells)) / len(cells)


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
    comments = [(at, line.strip()) for at, line in head if at < number and is_comment(line)]
    if comments and number == first:
        at, line = comments[-1]
        mark = next(mark for mark in COMMENT if line.startswith(mark))
        named = cells_of(line[len(mark) :], separator)
        if len(named) == len(cells) > 1 and not _has_data(named):
            return at, mark
    return first, ""


def _are_units(below: Sequence[Sequence[str]], width: int) -> bool:
    """Whether the row below a header of `width` names units: texts, or the 1 of a bare number, above values."""
    if len(below) < 2 or len(below[0]) != width or not _has_data(below[1]):
        return False
    texts = [cell for cell in below[0] if cell.strip() and cell.strip() != "1"]
    return bool(texts) and not _has_data(texts)


def _has_data(cells: Sequence[str]) -> bool:
    return any(is_value(cell) for cell in cells)


def is_value(cell: str) -> bool:
    """Whether a cell is a number, by either decimal mark, or a time."""
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
    """The header, then all that follows but comments and rows without any cell filled at the end, each with its line.

    Raises InputError for a quotation that does not end, and for a row of over 1,000,000 characters.
    """
    spaced, size = layout.separator == " ", 0  # characters of the row that is not complete

    def lines() -> Iterator[str]:
        nonlocal size
        for number, line in enumerate(io.StringIO(text, newline=""), 1):
            if number < layout.header or (number > layout.header and not size and is_comment(line)):
                yield "\n"
                continue
            if number == layout.header and layout.marked:
                line = line.lstrip()[len(layout.marked) :].lstrip(" ")
            begins, size = not size, size + len(line)
            if size > _MOST_CHARACTERS:
                raise InputError(f"{source}: a row has more than {_MOST_CHARACTERS:,} characters; a CSV file is needed")
            # trailing spaces would be one more cell
            yield line.rstrip(" \t\r\n") + "\n" if spaced and begins else line

    reader = csv.reader(lines(), delimiter=layout.separator, skipinitialspace=spaced, strict=True)
    blank: list[tuple[list[str], int]] = []
    while True:
        size, first = 0, reader.line_num + 1
        try:
            row = next(reader, None)
        except csv.Error as fault:
            raise InputError(f"{source}: line {first}: cannot be split into cells ({fault})") from None
        if row is None:
            return
        if not row or (len(row) == 1 and not row[0].strip()):  # nothing but a line's end
            continue
        if not any(cell.strip() for cell in row):  # spreadsheets leave such rows at the end
            blank.append((row, first))
            continue
        yield from blank
        blank.clear()
        yield row, first
