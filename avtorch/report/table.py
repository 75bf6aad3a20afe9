"""A table of the page: text in cells, each column with a title that also labels its cells on a phone."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from avtorch.errors import InputError


@dataclass(frozen=True)
class Table:
    """`columns` (column,) of titles; `rows` (row,) of as many cells, the first of which names its row.

    `caption`: what the table shows. `numeric`: titles of the columns of numbers. `marked`: numbers of the rows in bold;
    `soft`: of those that a terminal dims.
    Raises `InputError` where a row has another number of cells than there are columns.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: Collection[str] = ()
    marked: Collection[int] = ()
    soft: Collection[int] = ()

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise InputError(
                    f"table {self.caption!r}: found {len(row)} cells in row {i}, needs {len(self.columns)}"
                )
