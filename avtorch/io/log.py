"""The drive log: one row per sample, SI units, checked when it is made."""

from __future__ import annotations

import difflib
import io
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.errors import InputError
from avtorch.io.atomic import atomic
from avtorch.io.mapping import SIGNALS, Pairs, SignalMap, pairs, read_mapping
from avtorch.io.merge import held
from avtorch.io.tables import Table, read_table
from avtorch.io.units import to_si
from avtorch.io.validity import check_range, check_rate, check_time, check_units

STANDSTILL_MPS = 0.3
"""Below this speed GLVD does not hold; such rows are masked."""

GAP_STEPS = 3.0
GAP_SECONDS = 0.1
"""A step longer than both GAP_STEPS median steps and GAP_SECONDS is a gap: what is shorter is jitter or a lost row."""

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Log:
    """A drive. Every signal is ``(time,)``, float64, in SI units, or None where the log does not have it.

    ``time`` [s]; ``accel_cmd`` [m/s^2], the command sent, held until the next row (None only in a car-following log);
    ``accel`` [m/s^2] and ``speed`` [m/s], at least one of them; ``jerk`` [m/s^3]; ``engaged`` (bool, all true where the log
    does not tell); ``spacing`` [m, bumper to bumper]; ``lead_speed`` [m/s]; ``lead_accel`` [m/s^2]; ``grade`` [-];
    ``segment`` (int from 0; rises at each gap and each new value of the log's own column). ``name`` of the source; ``ignored``:
    its further columns; ``remarks``: what merging left out.
    """

    time: Float
    accel_cmd: Float | None
    accel: Float | None
    speed: Float | None
    jerk: Float | None
    engaged: NDArray[np.bool_]
    spacing: Float | None
    lead_speed: Float | None
    lead_accel: Float | None
    grade: Float | None
    segment: NDArray[np.int64]
    name: str = "log"
    ignored: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        *,
        map: Pairs = None,
        unit: Pairs = None,
        stamp: Pairs = None,
        following: bool = False,
    ) -> Log:
        """Read a CSV (UTF-8, comma, one header line) or Parquet log.

        ``map`` names the columns (``{"accel": "CAN.ACC_X"}`` or ``["accel=CAN.ACC_X"]``), ``unit`` their units
        (``speed=km/h``), ``stamp`` the signals' own time columns (``speed=GPS_TIME``); the TOML file beside the log may say
        the same, and more (`avtorch.io.mapping.read_mapping`). A stamped signal is held, not interpolated; naming the
        log's own time column as its stamp says that it is written only in the rows where it arrived. ``following`` lets a
        car-following log (``spacing`` and ``lead_speed``) come without ``accel_cmd``.

        Raises InputError, one line that names file, row (of data, from 1) and line (of the file) and column.
        """
        mapping = read_mapping(path, map=map, unit=unit, stamp=stamp)
        return _build(read_table(path), mapping, folder=Path(path).parent, following=following)

    @classmethod
    def from_arrays(cls, *, name: str = "arrays", unit: Pairs = None, following: bool = False, **columns: Any) -> Log:
        """A log from arrays ``(time,)`` by signal name, checked as a file is; None stands for a signal that is not there."""
        given = {}
        for key, values in columns.items():
            if key not in SIGNALS:
                raise InputError(f"{name}: {key!r} is no signal; signals: {', '.join(SIGNALS)}")
            if values is None:
                continue
            array = np.asarray(values)
            if array.ndim != 1:
                raise InputError(f"{name}: {key} has shape {array.shape}; one value per row, (time,), is needed")
            given[key] = array if array.dtype.kind in "fiu" else array.tolist()
        lengths = {key: len(values) for key, values in given.items()}
        if len(set(lengths.values())) > 1:
            raise InputError(f"{name}: signals differ in length: {', '.join(f'{k} {n}' for k, n in lengths.items())}")
        table = Table(name, tuple(given), tuple(given.values()))
        return _build(table, SignalMap(unit=pairs("unit", unit)), folder=Path(), following=following)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the log as Parquet (``.parquet``, ``.pq``) or CSV; to the bit the same when read again."""
        columns: dict[str, NDArray] = {}
        for name in SIGNALS:
            values = getattr(self, name)
            # what reading gives anyway is left out
            if values is None or (name == "engaged" and values.all()) or (name == "segment" and not values.any()):
                continue
            columns[name] = values.astype(np.int64) if name == "engaged" else values
        if Path(path).suffix.lower() in (".parquet", ".pq"):
            import pyarrow as pa
            import pyarrow.parquet as pq

            buffer = io.BytesIO()
            pq.write_table(pa.table(columns), buffer)
            with atomic(path, binary=True) as stream:
                stream.write(buffer.getvalue())
            return
        cells = [map(repr, values.tolist()) for values in columns.values()]
        with atomic(path) as stream:
            stream.write(",".join(columns) + "\n")
            stream.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))

    @property
    def rows(self) -> int:
        return len(self.time)

    @property
    def seconds(self) -> float:
        """Time recorded, gaps left out [s]."""
        return float(sum(self.time[part][-1] - self.time[part][0] for part in self.segments()))

    @property
    def rate_hz(self) -> float:
        """Rows per second, by the median step inside segments."""
        return 1 / median_step(self.time, np.diff(self.segment) == 0)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Rows not at standstill, ``(time,)``; all of them where the log has no speed."""
        return np.ones(self.rows, bool) if self.speed is None else self.speed >= STANDSTILL_MPS

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Rows that belief may use, ``(time,)``: engaged and not at standstill."""
        return self.engaged & self.moving

    def segments(self) -> list[slice]:
        """The separate drives, as slices of rows; between two of them lies a gap or a new value of ``segment``."""
        cuts = np.flatnonzero(np.diff(self.segment)) + 1
        edges = [0, *cuts.tolist(), self.rows]
        return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]

    def __getitem__(self, part: slice) -> Log:
        """The rows of a slice, as a log that keeps its segment numbers."""
        cut = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: v[part] for k, v in cut.items() if isinstance(v, np.ndarray)})


def stretches(mask: NDArray[np.bool_], segment: NDArray[np.int64]) -> list[slice]:
    """Unbroken runs of rows, within one segment each, where ``mask`` holds."""
    key = np.where(mask, segment, -1)
    cuts = np.flatnonzero(np.diff(key)) + 1
    edges = [0, *cuts.tolist(), len(key)]
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if mask[a]]


def median_step(time: Float, same_drive: NDArray[np.bool_]) -> float:
    """Median time between rows [s], steps across drives left out."""
    steps = np.diff(time)
    return float(np.median(steps[same_drive] if same_drive.any() else np.abs(steps)))


def _build(table: Table, mapping: SignalMap, *, folder: Path, following: bool) -> Log:
    source = table.source
    _require(table, mapping, following)
    if table.rows < 2:
        found = "one row" if table.rows == 1 else "a header but no rows"
        raise InputError(f"{source}: has {found}; a log needs at least two rows")
    signals: dict[str, Float] = {}
    arrivals: dict[str, tuple[Float, Float]] = {}
    for signal in SIGNALS:
        column = mapping.column.get(signal, signal)
        if signal in mapping.elsewhere:
            arrivals[signal] = _from_elsewhere(signal, mapping, folder)
        elif column in table.names:
            if signal in mapping.stamp:
                arrivals[signal] = _stamped(table, signal, column, mapping)
            else:
                signals[signal] = _signal(table, signal, column, mapping)
    for signal in mapping.unit:
        if signal not in signals and signal not in arrivals:
            raise InputError(f"{source}: unit {signal}={mapping.unit[signal]}: the log has no column for {signal}")

    time = signals["time"]
    drive = signals.get("segment", np.zeros(len(time)))
    clock = mapping.column.get("time", "time")
    check_time(time, np.diff(drive) == 0, _place(table, "time", clock))
    time_step = median_step(time, np.diff(drive) == 0)
    check_rate(time_step, f"{source}: column {clock!r}")

    remarks: list[str] = []
    keep = np.ones(len(time), bool)
    for signal, (stamps, values) in arrivals.items():
        signals[signal], age = held(time, stamps, values)
        # a value that is long overdue is no longer what the car does: those rows make a gap. States only tell changes.
        limit = max(GAP_STEPS * float(np.median(np.diff(stamps))) if len(stamps) > 1 else np.inf, GAP_SECONDS)
        limit = np.inf if signal in ("engaged", "segment") else limit + time_step
        stale = (age > limit) | np.isinf(age)
        if stale.any():
            remarks.append(f"{int(stale.sum())} rows left out where {signal} had not arrived or was older than {limit:.3g} s")
        keep &= ~stale
    if keep.sum() < 2:
        raise InputError(f"{source}: the signals with their own time stamps share {int(keep.sum())} rows with the log's clock")
    signals = {signal: values[keep] for signal, values in signals.items()}
    return _finish(table, mapping, signals, time_step, tuple(remarks))


def _finish(table: Table, mapping: SignalMap, signals: dict[str, Float], step: float, remarks: tuple[str, ...]) -> Log:
    time = signals["time"]
    fresh = np.diff(time) > max(GAP_STEPS * step, GAP_SECONDS)
    if "segment" in signals:
        fresh |= np.diff(signals["segment"]) != 0
    segment = np.concatenate([[0], np.cumsum(fresh)]).astype(np.int64)
    used = {mapping.column.get(signal, signal) for signal in SIGNALS if signal not in mapping.elsewhere}
    used |= set(mapping.stamp.values())
    log = Log(
        time=time,
        engaged=signals.get("engaged", np.ones(len(time))) == 1,
        segment=segment,
        **{name: signals.get(name) for name in SIGNALS if name not in ("time", "engaged", "segment")},
        name=table.source,
        ignored=tuple(name for name in table.names if name not in used),
        remarks=remarks,
    )
    parts = stretches(log.usable, segment)
    motion = {name: getattr(log, name) for name in ("accel_cmd", "accel", "speed", "lead_speed")}
    check_units(table.source, time, parts, **motion)
    return log


def _require(table: Table, mapping: SignalMap, following: bool) -> None:
    def there(signal: str) -> bool:
        return mapping.column.get(signal, signal) in table.names or signal in mapping.elsewhere

    for option in (mapping.column, mapping.stamp):
        for signal, column in option.items():
            if column not in table.names and signal not in mapping.elsewhere:
                raise InputError(
                    f"{table.source}: column {column!r}, named for {signal}, is missing; columns: {', '.join(table.names)}"
                )
    needed = ("time", "spacing", "lead_speed") if following and not there("accel_cmd") else ("time", "accel_cmd")
    for signal in needed:
        if not there(signal):
            raise InputError(f"{table.source}: column {signal!r} is missing; {_advice(signal, table.names)}")
    if not there("accel") and not there("speed"):
        raise InputError(
            f"{table.source}: columns 'accel' and 'speed' are both missing; one is needed; {_advice('speed', table.names)}"
        )
    for signal in mapping.stamp:
        if signal in mapping.elsewhere:
            raise InputError(f"{table.source}: {signal} is stamped here and also told to lie in another file; one is enough")


def _advice(signal: str, names: Iterable[str]) -> str:
    plain = {name.strip().lower(): name for name in names}
    close = difflib.get_close_matches(signal, plain, n=1, cutoff=0.6)
    name = f"{plain[close[0]]!r}" if close else "NAME"
    return f"columns: {', '.join(names)}; `--map {signal}={name}` if it goes by another name"


def _place(table: Table, signal: str, column: str, rows: NDArray | None = None) -> Callable[[int], str]:
    suffix = "" if column == signal else f" ({signal})"
    return lambda row: table.where(row if rows is None else int(rows[row]), column) + suffix


def _signal(table: Table, signal: str, column: str, mapping: SignalMap) -> Float:
    values = table.numbers(column)
    if signal in mapping.unit:
        values = to_si(signal, mapping.unit[signal])(values)
    check_range(signal, values, _place(table, signal, column))
    return values


def _stamped(table: Table, signal: str, column: str, mapping: SignalMap) -> tuple[Float, Float]:
    """Arrivals of a signal with a time column of its own in the log's table; rows empty in it brought nothing."""
    clock = mapping.stamp[signal]
    values = table.numbers(column, empty_is_nan=True)
    stamps = table.numbers(clock, empty_is_nan=True)
    unit = mapping.unit.get("time")
    own_clock = clock != mapping.column.get("time", "time")
    half = np.isnan(values) != np.isnan(stamps) if own_clock else np.zeros(len(values), bool)
    if half.any():
        row = int(np.argmax(half))
        empty, full = (column, clock) if np.isnan(values[row]) else (clock, column)
        raise InputError(f"{table.where(row, empty)}: is empty where {full!r} is not; both or neither are needed")
    rows = np.flatnonzero(~np.isnan(values))
    return _arrivals(table, signal, column, clock, values, stamps, rows, unit, mapping.unit.get(signal))


def _from_elsewhere(signal: str, mapping: SignalMap, folder: Path) -> tuple[Float, Float]:
    """Arrivals of a signal that lies in a file of its own, beside the log."""
    there = mapping.elsewhere[signal]
    table = read_table(folder / there.file)
    column = there.column or mapping.column.get(signal, signal)
    values, stamps = table.numbers(column), table.numbers(there.time)
    unit = there.time_unit or mapping.unit.get("time")
    rows = np.arange(len(values))
    return _arrivals(table, signal, column, there.time, values, stamps, rows, unit, mapping.unit.get(signal))


def _arrivals(
    table: Table, signal: str, column: str, clock: str, values: Float, stamps: Float, rows: NDArray,
    time_unit: str | None, unit: str | None,
) -> tuple[Float, Float]:  # fmt: skip
    if len(rows) == 0:
        raise InputError(f"{table.source}: column {column!r} ({signal}): holds no value at all")
    values, stamps = values[rows], stamps[rows]
    values = values if unit is None else to_si(signal, unit)(values)
    stamps = stamps if time_unit is None else to_si("time", time_unit)(stamps)
    check_range(signal, values, _place(table, signal, column, rows))
    # a recorder that writes the last arrival into every row repeats stamp and value together; that is one arrival
    again = np.concatenate([[False], (np.diff(stamps) == 0) & (np.diff(values) == 0)])
    rows, values, stamps = rows[~again], values[~again], stamps[~again]
    check_time(stamps, np.ones(len(stamps) - 1, bool), _place(table, f"stamp of {signal}", clock, rows))
    return stamps, values
