"""NGSIM car-following events: one alone, or several joined at equal speed because few last long enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io.raw_leader import RawLeader, checked_leader
from avtorch.io.tables import Table

DURATION_S = 80.0
JOIN_SPEED_MPS = 0.2
JOIN_WITHIN_S = 5.0
_LOOK_S = 0.5  # the acceleration on either side of a joint is taken over this long


def read_event(table: Table, event: int) -> RawLeader:
    """The leader of one event; its time starts at 0. InputError where the file has no such event."""
    table = _parsed(table)
    return _event(table, _numbers(table), event)


def join_events(table: Table, *, duration: float | None = None, first: int | None = None) -> RawLeader:
    """A leader of at least ``duration`` [s] (default 80) out of events joined at equal speed.

    Rule. Start with the longest event, or ``first``. At its end, search the first 5 s of every event not yet used
    (each leaves at least 10 s to drive) for samples whose lead speed is within 0.2 m/s of the last one; take the sample
    whose acceleration over the next 0.5 s is nearest to that of the last 0.5 s, ties to the lower event number, and go
    on from the sample after it, speeds as recorded. ``events`` and ``note`` of the result list what was joined. Raises
    InputError where no event fits before ``duration`` is reached.
    """
    wanted = DURATION_S if duration is None else float(duration)
    if not 0 < wanted < np.inf:
        raise InputError(f"duration: is {duration}; a positive number of seconds is needed")
    table = _parsed(table)
    numbers = _numbers(table)
    ids, counts = np.unique(numbers, return_counts=True)
    start = int(ids[np.argmax(counts)]) if first is None else first
    leaders = {int(i): _event(table, numbers, int(i)) for i in ids}
    if start not in leaders:
        raise InputError(f"{table.source}: event {start} is not in it; events {ids[0]:.0f} to {ids[-1]:.0f} are")
    time, speed = leaders[start].time, leaders[start].speed
    used, joints = [start], []
    while time[-1] < wanted - 1e-9:
        fit = _best_fit(time, speed, {i: x for i, x in leaders.items() if i not in used})
        if fit is None:
            raise InputError(
                f"{table.source}: after {time[-1]:.1f} s (events {used}) no further event starts within "
                f"{JOIN_SPEED_MPS} m/s of {speed[-1]:.2f} m/s; ask for a shorter duration than {wanted:g} s"
            )
        event, sample = fit
        other = leaders[event]
        joints.append(f"at {time[-1]:.1f} s")
        time = np.concatenate([time, time[-1] + other.time[sample + 1 :] - other.time[sample]])
        speed = np.concatenate([speed, other.speed[sample + 1 :]])
        used.append(event)
    listing = ", ".join(map(str, used))
    note = f"events {listing} joined at equal speed ({', '.join(joints)})" if joints else f"event {listing}"
    return RawLeader(time, speed, None, None, f"NGSIM {'+'.join(map(str, used))}", note, tuple(used))


def _best_fit(time: NDArray, speed: NDArray, others: dict[int, RawLeader]) -> tuple[int, int] | None:
    before = _slope(time, speed, time[-1] - _LOOK_S, time[-1])
    best: tuple[float, int, int] | None = None
    for event, other in others.items():
        early = other.time <= min(JOIN_WITHIN_S, other.time[-1] - 10)
        for sample in np.flatnonzero(early & (np.abs(other.speed - speed[-1]) <= JOIN_SPEED_MPS)):
            at = other.time[sample]
            kink = abs(_slope(other.time, other.speed, at, at + _LOOK_S) - before)
            if best is None or (kink, event, int(sample)) < best:
                best = (kink, event, int(sample))
    return None if best is None else best[1:]


def _slope(time: NDArray, speed: NDArray, start: float, end: float) -> float:
    a, b = np.interp([start, end], time, speed)
    return float(b - a) / (end - start)


def _parsed(table: Table) -> Table:
    """The three columns needed, read once for all events."""
    names = ("event", "time", "lead_speed")
    return Table(table.source, names, tuple(table.numbers(name) for name in names), table.lines)


def _numbers(table: Table) -> FloatArray:
    numbers = table.numbers("event")
    bad = numbers != np.round(numbers)
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"{table.where(row, 'event')}: is {numbers[row]:g}; a whole number is needed")
    return numbers


def _event(table: Table, numbers: NDArray, event: int) -> RawLeader:
    rows = np.flatnonzero(numbers == event)
    if len(rows) == 0:
        raise InputError(
            f"{table.source}: event {event} is not in it; events {numbers.min():.0f} to {numbers.max():.0f} are"
        )
    if rows[-1] - rows[0] + 1 != len(rows):
        cut = rows[int(np.argmax(np.diff(rows) > 1)) + 1]
        raise InputError(
            f"{table.where(int(cut), 'event')}: event {event} goes on after another; keep its rows together"
        )
    part = slice(int(rows[0]), int(rows[-1]) + 1)
    lines = None if table.lines is None else table.lines[part]
    piece = Table(
        table.source,
        table.names,
        tuple(None if cells is None else cells[part] for cells in table.cells),
        lines,
        first=part.start,
    )
    leader = checked_leader(
        piece,
        piece.numbers("time"),
        piece.numbers("lead_speed"),
        None,
        None,
        columns={"time": "time", "speed": "lead_speed"},
        name=f"NGSIM {event}",
    )
    note = "; ".join(x for x in (f"event {event}", leader.note) if x)
    return RawLeader(leader.time, leader.speed, None, None, leader.name, note, (event,))
