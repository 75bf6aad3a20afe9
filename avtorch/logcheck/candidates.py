"""Columns of a log as numbers, and which of them may be which signal by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.formats.presets import PRESETS, Preset, Source
from avtorch.io.merge import held, merged
from avtorch.io.recording import Recording
from avtorch.io.tables import Table, whole_stamps
from avtorch.io.validity import MOST_BAD
from avtorch.logcheck.header import Header, header_of
from avtorch.logcheck.vocabulary import likeness, signals_named

_MOST = 5  # columns that are tried for a signal
_KNOWN = 3.0  # likeness of a column of a known layout
_STAMP = 1.5  # likeness of a stamp in seconds and nanoseconds, which only avtorch's own name for the clock exceeds


@dataclass(frozen=True, eq=False)
class Column:
    """A column that holds numbers: `values` (row,), NaN where a cell holds none; `likeness` by signal; `when`:
    numbers that mean yes, by a known `layout`."""

    header: Header
    values: FloatArray
    likeness: Mapping[str, float]
    when: tuple[int, ...] = ()
    layout: str | None = None

    @property
    def name(self) -> str:
        return self.header.name


def columns_of(table: Table) -> list[Column]:
    """The columns of a table that hold numbers or times, but for a twentieth of their cells."""
    found = []
    preset, known = layout_of(table.names)
    stamps = whole_stamps(table.names)
    for name in dict.fromkeys(table.names):
        if table.names.count(name) > 1:
            continue
        layout = {signal: source for signal, (column, source) in known.items() if column == name}
        unit = next((source.unit for source in layout.values() if source.unit), None)
        header = header_of(name, unit or table.units.get(name))
        alike = {signal: x for signal in signals_named() if (x := likeness(header, signal)) > 0 and signal not in known}
        alike |= dict.fromkeys(layout, _KNOWN)
        alike |= dict.fromkeys(("time",) if name in stamps else (), _STAMP)
        read = table.readings(name, empty_is_nan=True, as_time="time" in alike, as_state=True)
        if len(read.values) and len(read.faults) <= MOST_BAD * len(read.values) and np.isfinite(read.values).any():
            when = next((source.when for source in layout.values()), ())
            found.append(Column(header, read.values, alike, when, preset.words if preset and layout else None))
    return found


def table_of(recording: Recording) -> Table:
    """The channels of a recording that may be signals by their names, held on the clock of the fastest of them.

    Those of a known layout stand alone for their signals.
    """
    _, known = layout_of(recording.names)
    # channels of a recording bring their clocks along, so a layout's column of time is none of them
    named: dict[str, list[str]] = {signal: [channel] for signal, (channel, _) in known.items() if signal != "time"}
    for name in recording.names:
        header = header_of(name, recording.units.get(name))
        for signal in signals_named():
            if signal not in known and signal != "time" and likeness(header, signal) > 0:
                named.setdefault(signal, []).append(name)
    ranked_names = {
        signal: sorted(names, key=lambda name, s=signal: -likeness(header_of(name), s))[:_MOST]
        for signal, names in named.items()
    }
    # the clock is the best candidates'; all others are held on it
    first = {signal: names[0] for signal, names in ranked_names.items()}
    rest = {f"{signal} {n}": name for signal, names in ranked_names.items() for n, name in enumerate(names[1:])}
    table, arrivals = merged(recording, {**rest, **first})
    columns = {**rest, **first}
    clock = table.numbers("time")
    cells = {name: cell for name, cell in zip(table.names, table.cells, strict=True) if cell is not None}
    for key, (stamps, values) in arrivals.items():
        cells[columns[key]] = held(clock, stamps, values)[0]
    units = {name: unit for name, unit in recording.units.items() if name in cells}
    return replace(table, names=tuple(cells), cells=tuple(cells.values()), units=units)


def layout_of(names: Iterable[str]) -> tuple[Preset | None, dict[str, tuple[str, Source]]]:
    """The known layout of a log with columns `names`: one that has a command and a response; nothing otherwise."""
    there = tuple(names)
    for preset in PRESETS.values():
        found = preset.find(there)
        if "accel_cmd" in found and ("speed" in found or "accel" in found):
            return preset, {signal: one for signal, one in found.items() if signal in signals_named()}
    return None, {}


def ranked(columns: list[Column], signal: str) -> list[Column]:
    """Columns that may be the signal by their name, the likeliest first."""
    named = [column for column in columns if signal in column.likeness]
    return sorted(named, key=lambda column: -column.likeness[signal])[:_MOST]
