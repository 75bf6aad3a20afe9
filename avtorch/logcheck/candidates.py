"""Columns of a log as numbers, and which of them may be which signal by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.bad_rows import MOST_BAD
from avtorch.io.tables import Table
from avtorch.logcheck.header import Header, header_of
from avtorch.logcheck.vocabulary import likeness, signals_named

_MOST = 5  # columns that are tried for a signal


@dataclass(frozen=True, eq=False)
class Column:
    """A column that holds numbers: `values` (row,), NaN where a cell holds none; `likeness` by signal."""

    header: Header
    values: FloatArray
    likeness: Mapping[str, float]

    @property
    def name(self) -> str:
        return self.header.name


def columns_of(table: Table) -> list[Column]:
    """The columns of a table that hold numbers or times, but for a twentieth of their cells."""
    found = []
    for name in dict.fromkeys(table.names):
        if table.names.count(name) > 1:
            continue
        header = header_of(name, table.units.get(name))
        alike = {signal: x for signal in signals_named() if (x := likeness(header, signal)) > 0}
        read = table.readings(name, empty_is_nan=True, as_time="time" in alike, as_state=True)
        if len(read.values) and len(read.faults) <= MOST_BAD * len(read.values) and np.isfinite(read.values).any():
            found.append(Column(header, read.values, alike))
    return found


def ranked(columns: list[Column], signal: str) -> list[Column]:
    """Columns that may be the signal by their name, the likeliest first."""
    named = [column for column in columns if signal in column.likeness]
    return sorted(named, key=lambda column: -column.likeness[signal])[:_MOST]
