"""A table of the page: text in cells, each column with a title that also labels its cells on a phone."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """`columns` (column,) of titles; `rows` (row,) of as many cells, the first of which names its row.

    `caption`: what the table shows. `numeric`: titles of the columns of numbers. `marked`: numbers of the rows in bold;
    `soft`: of those that a terminal dims.
    """

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: Collection[str] = ()
    marked: Collection[int] = ()
    soft: Collection[int] = ()
