"""Signals that come with their own time stamps, brought onto one clock: held, never interpolated.

Channels of a recording become one table on the clock of the fastest of them, and what arrives beside it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io.formats.listed import Channel, Recording
from avtorch.io.tables import Table
from avtorch.io.validity import RATE_HZ


def held(clock: FloatArray, stamps: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The last value that had arrived at each tick of ``clock``, and its age [s].

    ``clock`` is ``(time,)``, ``stamps`` and ``values`` are ``(message,)``, stamps strictly rising; both answers are
    ``(time,)``. Before the first message there is nothing to hold: value NaN, age infinite. Interpolating instead would
    let a value act before it was measured. Raises InputError for stamps that do not rise.

    Example:
        >>> import numpy as np
        >>> from avtorch.io import held
        >>> clock, stamps, commands = np.array([0.0, 0.1, 0.2]), np.array([0.05, 0.18]), np.array([1.0, 2.0])
        >>> value, age = held(clock, stamps, commands)
        >>> value.tolist(), age.round(2).tolist()
        ([nan, 1.0, 2.0], [inf, 0.05, 0.02])
    """
    if len(stamps) != len(values):
        raise InputError(f"stamps: {len(stamps)} of them for {len(values)} values; one each is needed")
    if len(stamps) == 0:
        raise InputError("stamps: none given; a signal needs at least one value")
    if np.any(np.diff(stamps) <= 0):
        message = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise InputError(
            f"stamps: message {message + 1} has {stamps[message]:g} s after {stamps[message - 1]:g} s; they must rise"
        )
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
