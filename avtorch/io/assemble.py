"""From a table or a recording, and a mapping, to the signals of a log: find, convert, check, and merge onto one clock.

Signals that come with their own time stamps are held, never interpolated. Channels of a recording become one table on
the clock of the fastest of them, and what arrives beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.clock import clock_words, gap_limit, median_step, since, since_start
from avtorch.io.formats.listed import Channel, Recording
from avtorch.io.mapping import PEDALS, SIGNALS, SignalMap
from avtorch.io.tables import Table
from avtorch.io.units import stated_unit, to_si
from avtorch.io.validity import RATE_HZ, BadRows, check_range, check_rate, check_time, time_faults


def held(clock: FloatArray, stamps: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The last value that had arrived at each tick of ``clock`` (time,), and its age [s]; ``stamps``, strictly rising,
    and ``values`` (message,).

    Before the first message there is nothing to hold: value NaN, age infinite. Interpolating instead would let a value
    act before it was measured.
    """
    last = np.searchsorted(stamps, clock, side="right") - 1
    known = last >= 0
    at = np.maximum(last, 0)
    return np.where(known, values[at], np.nan), np.where(known, clock - stamps[at], np.inf)


Arrivals = dict[str, tuple[FloatArray, FloatArray]]
"""Stamps and values (message,) by signal."""
_CLOCKS = ("accel_cmd", "accel", "speed")
_CLOCK = "time"


def merged(recording: Recording, columns: Mapping[str, str]) -> tuple[Table, Arrivals]:
    """The channels `columns` (by signal) of a recording: a table of those on its clock, and arrivals of the others.

    The clock is that of the fastest of command, acceleration and speed; one of over 200 Hz is thinned out. Raises
    `InputError` for a recording that has none of them.
    """
    wanted = {signal: name for signal, name in columns.items() if name in recording.names}
    channels = recording.read(set(wanted.values()))
    clean = {signal: _clean(channels[name]) for signal, name in wanted.items()}
    clean = {signal: pair for signal, pair in clean.items() if len(pair[0])}
    clocks = [clean[signal][0] for signal in _CLOCKS if signal in clean and len(clean[signal][0]) > 1]
    if not clocks:
        there = ", ".join(wanted) or "none"
        raise InputError(
            f"{recording.source}: found {there} of accel_cmd, accel and speed with two samples or more; needs one"
        )
    clock = _thinned(min(clocks, key=lambda time: float(np.median(np.diff(time)))))
    cells: dict[str, FloatArray] = {_CLOCK: clock}
    arrivals: Arrivals = {}
    for signal, (time, values) in clean.items():
        if len(time) == len(clock) and np.array_equal(time, clock):
            cells[columns[signal]] = values
        else:
            arrivals[signal] = time, values
    names = (_CLOCK, *(name for name in recording.names if name != _CLOCK))
    return (
        Table(
            recording.source,
            names,
            tuple(cells.get(name) for name in names),
            units={columns[signal]: unit for signal, unit in _units(recording, wanted).items()},
            remarks=tuple(recording.remarks),
            form=recording.form,
        ),
        arrivals,
    )


def _units(recording: Recording, wanted: Mapping[str, str]) -> dict[str, str]:
    return {signal: recording.units[name] for signal, name in wanted.items() if name in recording.units}


def _clean(channel: Channel) -> tuple[FloatArray, FloatArray]:
    """Stamps that rise, and their values: of samples with one stamp the last counts."""
    known = np.isfinite(channel.time) & np.isfinite(channel.values)
    time, values = channel.time[known], channel.values[known]
    if (np.diff(time) <= 0).any():
        order = np.argsort(time, kind="stable")
        time, values = time[order], values[order]
        last = np.concatenate([np.diff(time) > 0, [True]])
        time, values = time[last], values[last]
    return time, values


def _thinned(time: FloatArray) -> FloatArray:
    rate = 1.0 / float(np.median(np.diff(time)))
    return time if rate <= 1.05 * RATE_HZ[1] else time[:: int(np.ceil(rate / RATE_HZ[1] - 1e-6))]


# change of speed that an accelerometer in order notices: 1 m/s, and a tenth of the speed of what is slower
_DEAD_MPS, _DEAD_SHARE = 1.0, 0.1


def assemble(table: Table, mapping: SignalMap, *, following: bool, arrived: Arrivals | None = None) -> dict[str, Any]:
    """Find, convert, check and merge the signals of a log; returns the fields of a `Log` by name.

    ``arrived`` holds signals that are not in the table. Rows where a signal with its own stamps had not arrived, or is
    older than three of its own steps (0.1 s at least), are left out, which makes a gap; ``engaged`` and ``segment`` are
    states whose messages mark changes only, so they are held indefinitely. Raises InputError for everything that is
    certainly wrong.
    """
    source = table.source
    arrived = arrived or {}
    mapping = _with_stated_units(table, mapping)
    _require(table, mapping, following)
    if table.rows < 2:
        found = "one row" if table.rows == 1 else "a header but no rows"
        raise InputError(f"{source}: has {found}; a log needs at least two rows")
    signals: dict[str, FloatArray] = {}
    arrivals: Arrivals = {}
    bad, remarks = BadRows(table.rows), list(table.remarks)
    spare = _not_needed(table, mapping, arrived)
    for signal in SIGNALS:
        if signal in spare:
            _spare(table, mapping, signal, signals, remarks)
        elif signal in arrived:
            arrivals[signal] = _arrivals(table, mapping, signal, "its clock", *arrived[signal])
        elif mapping.column_of(signal) in table.names:
            if signal in mapping.stamp:
                arrivals[signal] = _stamped(table, mapping, signal)
            else:
                signals[signal] = _signal(table, mapping, signal, bad)
    for signal in mapping.unit:
        if signal not in signals and signal not in arrivals:
            raise InputError(f"{source}: unit {signal}={mapping.unit[signal]}: the log has no column for {signal}")

    clock = mapping.column_of("time")
    _leave_out_disordered(table, signals, clock, bad)
    signals = {signal: values[bad.kept] for signal, values in signals.items()}
    remarks += bad.remarks()
    time = signals["time"]
    if len(time) < 2:
        raise InputError(f"{source}: has {len(time)} rows without a bad cell; a log needs at least two rows")
    drive = signals.get("segment", np.zeros(len(time)))
    # gaps are not known yet: drives follow from the log's own column, whose numbers may be of any size
    elapsed = since_start(time, np.concatenate([[0], np.cumsum(np.diff(drive) != 0)]))
    time_step = median_step(elapsed, np.diff(drive) == 0)
    check_rate(time_step, f"{source}: column {clock!r}")

    keep = np.ones(len(time), bool)
    for signal, (stamps, values) in arrivals.items():
        largest = max(float(np.abs(x).max()) for x in (time, stamps))
        origin = float(time[0])
        ticks, sent = (since(x, origin, largest=largest) for x in (time, stamps))
        signals[signal], age = held(ticks, sent, values)
        # a value that is long overdue no longer describes the car: its rows form a gap. States are sent only on a
        # change.
        limit = gap_limit(float(np.median(np.diff(sent)))) if len(sent) > 1 else np.inf
        limit = np.inf if signal in ("engaged", "segment") else limit + time_step / 2
        stale = (age > limit) | np.isinf(age)
        if stale.any():
            count = int(stale.sum())
            remarks.append(f"{count} rows left out where {signal} had not arrived or was older than {limit:.3g} s")
        keep &= ~stale
    if keep.sum() < 2:
        raise InputError(
            f"{source}: the signals with time stamps of their own ({', '.join(arrivals)}) share {int(keep.sum())} rows "
            f"with the log's clock ({elapsed[-1]:.6g} s from {clock_words(float(time[0]))}); at least two are needed"
        )
    signals = {signal: values[keep] for signal, values in signals.items()}
    _leave_out_dead(signals, mapping, remarks)
    fresh = np.diff(elapsed[keep]) > gap_limit(time_step)
    if "segment" in signals:
        fresh |= np.diff(signals["segment"]) != 0
    segment = np.concatenate([[0], np.cumsum(fresh)]).astype(np.int64)
    used = {mapping.column_of(signal) for signal in SIGNALS}
    used |= set(mapping.stamp.values())
    ignored = tuple(printable(name, 200) for name in table.names if name not in used)
    fields = {signal: signals.get(signal) for signal in SIGNALS}
    fields["engaged"] = signals.get("engaged", np.ones(len(segment))) == 1
    return {**fields, "segment": segment, "name": source, "ignored": ignored, "remarks": tuple(remarks)}


def _leave_out_dead(signals: dict[str, FloatArray], mapping: SignalMap, remarks: list[str]) -> None:
    """Leave out an acceleration that never moves on a drive whose speed is no straight line over time: a lag fitted to
    it would be minutes."""
    if "accel" not in signals or "speed" not in signals or np.ptp(signals["accel"]) > 0:
        return
    time, speed = signals["time"] - signals["time"].mean(), signals["speed"]
    change = float(np.ptp(speed))
    if np.ptp(speed - time * (time @ speed) / max(float(time @ time), 1e-12)) > min(
        _DEAD_MPS, _DEAD_SHARE * float(np.abs(speed).max())
    ):
        value = float(signals.pop("accel")[0])
        remarks.append(
            f"column {mapping.column_of('accel')!r} is {value:g} in every row while speed changes by "
            f"{change:.3g} m/s: the sensor is dead, and accel left out"
        )


def _with_stated_units(table: Table, mapping: SignalMap) -> SignalMap:
    """The mapping, with the units that the file itself states for columns for which none is given."""
    stated = {}
    for signal in SIGNALS:
        text = table.units.get(mapping.column_of(signal))
        if text is not None and (unit := stated_unit(signal, text)) is not None:
            stated[signal] = unit
    return replace(mapping, unit=stated | mapping.unit)


def _converted(signal: str, values: FloatArray, mapping: SignalMap) -> FloatArray:
    """Values as recorded in SI units, and states as 0 and 1."""
    if signal in mapping.state:
        return np.where(np.isnan(values), np.nan, np.isin(values, mapping.state[signal]).astype(np.float64))
    return to_si(signal, mapping.unit[signal])(values) if signal in mapping.unit else values


def _require(table: Table, mapping: SignalMap, following: bool) -> None:
    def there(signal: str) -> bool:
        return mapping.column_of(signal) in table.names

    for option in (mapping.column, mapping.stamp):
        for signal, column in option.items():
            if column not in table.names:
                there_are = listed(table.names)
                raise InputError(f"{table.source}: column {quoted(column)} ({signal}) is missing; columns: {there_are}")
    commanded = any(there(signal) for signal in ("accel_cmd", *PEDALS, "speed_cmd"))
    if following and not there("accel_cmd"):
        needed = ("time", "spacing", "lead_speed")
    else:
        needed = ("time",) if commanded else ("time", "accel_cmd")
    for signal in needed:
        if not there(signal):
            advice = _advice(signal, table)
            if signal == "accel_cmd" and there("spacing") and there("lead_speed"):
                advice += "; `--follower` diagnoses a car-following log without it"
            elif signal == "accel_cmd":
                advice += f"; {', '.join(PEDALS)} or speed_cmd can stand for it"
            raise InputError(f"{table.source}: column {signal!r} is missing; {advice}")
    if not there("accel") and not there("speed"):
        advice = _advice("speed", table)
        raise InputError(f"{table.source}: columns 'accel' and 'speed' are both missing; one is needed; {advice}")


def _advice(signal: str, table: Table) -> str:
    option = {signal: "NAME"}
    return f"columns: {listed(table.names)}; `--map {signal}=NAME` or `map={option}` if it goes by another name"


def _place(table: Table, signal: str, column: str, rows: NDArray | None = None) -> Callable[[int], str]:
    suffix = "" if column == signal else f" ({signal})"
    return lambda row: table.where(row if rows is None else int(rows[row]), column) + suffix


def _signal(table: Table, mapping: SignalMap, signal: str, bad: BadRows) -> FloatArray:
    """A signal (row,) in SI units, NaN in rows that are left out."""
    column = mapping.column_of(signal)
    read = table.readings(column, as_time=signal == "time", as_state=signal == "engaged")
    bad.leave_out(read.faults)
    values = _converted(signal, read.values, mapping)
    outside = check_range(signal, values, _place(table, signal, column), spares=True)
    bad.leave_out(outside)
    values[list(outside)] = np.nan
    return values


def _not_needed(table: Table, mapping: SignalMap, arrived: Arrivals) -> set[str]:
    """Commands that are no accelerations, in a log that has one and does not ask for them by its mapping."""
    command = "accel_cmd" in arrived or mapping.column_of("accel_cmd") in table.names
    others = {*PEDALS, "speed_cmd"} - set(mapping.column) - set(mapping.unit)
    return others if command else set()


def _spare(table: Table, mapping: SignalMap, signal: str, signals: dict[str, FloatArray], remarks: list[str]) -> None:
    """Reads a signal that is not needed, or tells why it is left out: it costs no row and refuses no log."""
    if signal not in table.names or table.cells[table.names.index(signal)] is None:
        return
    rows = BadRows(table.rows)
    try:
        values = _signal(table, mapping, signal, rows)
    except InputError as fault:
        remarks.append(f"{fault}; {signal} is left out")
        return
    if rows.kept.all():
        signals[signal] = values
    else:
        remarks.append(f"{rows.remarks()[0].removesuffix('; the row is left out')}; {signal} is left out")


def _leave_out_disordered(table: Table, signals: dict[str, FloatArray], clock: str, bad: BadRows) -> None:
    """Leaves out the rows whose stamps do not rise or are on no clock; InputError where they are many."""
    rows = np.flatnonzero(bad.kept)
    time = signals["time"]
    drive = signals.get("segment", np.zeros(len(time)))
    faults = time_faults(time[rows], drive[rows], _place(table, "time", clock, rows))
    bad.leave_out({int(rows[row]): words for row, words in faults.items()})


def _stamped(table: Table, mapping: SignalMap, signal: str) -> tuple[FloatArray, FloatArray]:
    """Arrivals of a signal with a time column of its own in the log's table; empty rows are no arrivals."""
    column, clock = mapping.column_of(signal), mapping.stamp[signal]
    values = table.numbers(column, empty_is_nan=True)
    stamps = table.numbers(clock, empty_is_nan=True)
    half = np.isnan(values) != np.isnan(stamps)
    if clock != mapping.column_of("time") and half.any():
        row = int(np.argmax(half))
        empty, full = (column, clock) if np.isnan(values[row]) else (clock, column)
        raise InputError(f"{table.where(row, empty)}: is empty where {full!r} is not; both or neither are needed")
    stamps = to_si("time", mapping.unit.get("time", "s"))(stamps)
    return _arrivals(table, mapping, signal, clock, stamps, values)


def _arrivals(
    table: Table, mapping: SignalMap, signal: str, clock: str, stamps: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Stamps and values (message,) in SI units, checked, of those that are there."""
    column = mapping.column_of(signal)
    rows = np.flatnonzero(~np.isnan(values))
    if len(rows) == 0:
        raise InputError(f"{table.source}: column {column!r} ({signal}): holds no value at all")
    stamps, values = stamps[rows], _converted(signal, values[rows], mapping)
    check_range(signal, values, _place(table, signal, column, rows))
    # a recorder that writes the last arrival into every row repeats stamp and value together; that is one arrival
    again = np.concatenate([[False], (np.diff(stamps) == 0) & (np.diff(values) == 0)])
    rows, stamps, values = rows[~again], stamps[~again], values[~again]
    check_time(stamps, _place(table, f"stamp of {signal}", clock, rows))
    return stamps, values
