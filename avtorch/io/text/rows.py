"""Rows of cells of a table of text, each with the number of its line."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator

from avtorch.errors import InputError
from avtorch.io.text.layout import Layout, is_comment

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
