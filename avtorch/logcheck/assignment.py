"""Which columns are command, acceleration and speed: names and data weighed together, in nats.

A name is a prior. The data are how the changes of one column go with the integral of another: of a speed and an
acceleration the two are one motion, of a command and the motion one follows the other. Each pair's correlation is far
likelier between the right columns than between others (`_evidence`). The assignment of the highest sum is taken; where
the next one, of a column that moves otherwise, is within `PLAIN`, or where a column is named as a signal that it does
not move like, that is a question.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.assemble import held, merged
from avtorch.io.formats.listed import Recording
from avtorch.io.tables import Table, whole_stamps
from avtorch.io.validity import DELAYS_S, MIN_SPANS, MOST_BAD, SPANS_S, codes, integral
from avtorch.logcheck.layouts import layout_of
from avtorch.logcheck.recorder import lateness, slope_of
from avtorch.logcheck.vocabulary import NAMED_SIGNALS, Header, bare_unit, header_of, likeness, means_otherwise

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

    @property
    def by_what(self) -> str:
        """What tells which signal it is."""
        return f"by the layout of {self.layout}" if self.layout else "by its name"


def columns_of(table: Table) -> list[Column]:
    """The columns of a table that hold numbers or times, but for a twentieth of their cells."""
    found = []
    words, known = layout_of(table.names)
    stamps = whole_stamps(table.names)
    for name in dict.fromkeys(table.names):
        if table.names.count(name) > 1:
            continue
        layout = {signal: source for signal, (column, source) in known.items() if column == name}
        unit = next((source.unit for source in layout.values() if source.unit), None)
        header = header_of(name, unit or table.units.get(name))
        alike = {signal: x for signal in NAMED_SIGNALS if (x := likeness(header, signal)) > 0 and signal not in known}
        alike |= dict.fromkeys(layout, _KNOWN)
        alike |= dict.fromkeys(("time",) if name in stamps else (), _STAMP)
        read = table.readings(name, empty_is_nan=True, as_time="time" in alike, as_state=True)
        if len(read.values) and len(read.faults) <= MOST_BAD * len(read.values) and np.isfinite(read.values).any():
            when = next((source.when for source in layout.values()), ())
            found.append(Column(header, read.values, alike, when, words if layout else None))
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
        for signal in NAMED_SIGNALS:
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


def ranked(columns: list[Column], signal: str) -> list[Column]:
    """Columns that may be the signal by their name, the likeliest first."""
    named = [column for column in columns if signal in column.likeness]
    return sorted(named, key=lambda column: -column.likeness[signal])[:_MOST]


MOTION: tuple[str, ...] = ("accel_cmd", "accel", "speed")
PLAIN = 3.0
"""Nats by which a choice must lead another one for that to be ruled out."""

_NAMED, _OWN = 3.0, 6.0
"""Nats of a name with nothing besides, and of avtorch's own name for a signal or a known layout's: such a column is
something else once in twenty, and once in four hundred."""
_OTHERWISE = -3.0
"""Nats of a name that says something else, such as `lead_speed`, `LatAcc` or `throttle`."""
_TAKEN = 0.6
"""Nats from which a column is taken: a correlation of 0.8 where no name tells, or a name that no data contradict."""
_TOLD = -1.0
"""Nats of data from which a column is worth a question: a correlation of 0.63 of one motion."""
_STEEP = {"motion": 7, "response": 3}
"""Power of the correlation with which its density rises between right columns; a car's answer is looser than one motion
read twice. Between others it is even."""
_LOST = 0.05
"""Share of right columns whose correlation is anything: noise, a slope, a driver at the pedals."""
_CALM = 0.01
"""Change within a span, as a share of the top speed, below which a drive tells nothing about names."""
_CHANCE = 3.1
"""Standard deviations of Fisher's z beyond which a correlation lies once in 500 tries; each column has some forty, by
channels, spans and delays."""
_ALIKE = 0.98  # correlation from which two columns measure one thing
_TRIED, _KEPT = 60, 3  # columns without a telling name that are compared with the others, and kept of them
_MOST_STATES = 8  # numbers of a column that is a flag or a state
_LARGEST = 1e9  # of a speed or an acceleration, in any unit
_ACCELS = ("m/s2", "g", "mg", "cm/s2", "ft/s2")


class Assigned(NamedTuple):
    """The columns `found` by signal, the `reasons` of each, and `doubts`, in sentences."""

    found: dict[str, Column]
    reasons: dict[str, list[str]]
    doubts: list[str]


def assign(clock: FloatArray, parts: list[slice], columns: list[Column], given: Mapping[str, str]) -> Assigned:
    """Assigns columns to command, acceleration and speed, whose stamps are `clock` (row,) [s]; `given`: those that the
    user named."""
    taken = set(given.values())
    options: dict[str, list[Column]] = {}
    moving = [column for column in columns if moves(column)]
    unnamed = [c for c in moving if c.name not in taken and not c.likeness and not is_state(c)][:_TRIED]
    for signal in MOTION:
        if signal in given:
            options[signal] = [column for column in columns if column.name == given[signal]]
            continue
        named = [c for c in ranked(moving, signal) if c.name not in taken and (not is_state(c) or c.name == signal)]
        rest = [c for c in unnamed if signal != "accel" or _unit_of_accel(c) is not None]
        options[signal] = [*named, *rest]
    motion = _Motion(clock, parts, options)
    options = {s: options[s] if s in given else _promising(s, options, motion) for s in MOTION}
    choices = sorted(_choices(options, motion, given), key=lambda choice: -choice[0])
    found, reasons, doubts = {}, {}, []
    best = choices[0][1]
    for signal in MOTION:
        column = best[signal]
        question = None if signal in given else _question(signal, choices, motion)
        if question is not None:
            doubts.append(question)
        # what bears the signal's own name is read as that in any case
        if column is None or (question is not None and column.name != signal):
            continue
        if signal == "accel_cmd" and not column.likeness and _one_sided(filled(column)):
            doubts.append(
                f"the car's motion follows {column.name} (correlation "
                f"{motion.strongest(signal, column, best)[0]:.2f}), which is never about zero as an "
                "acceleration is; name it with --map throttle=COLUMN, torque=COLUMN or what it is"
            )
            continue
        found[signal] = column
        reasons[signal] = _reasons(signal, column, best, motion, signal in given)
    return Assigned(found, reasons, doubts)


def moves(column: Column) -> bool:
    """Whether a column changes, by numbers that a car's motion can have in any unit."""
    values = column.values[np.isfinite(column.values)]
    return bool(np.abs(values).max() < _LARGEST and values.min() < values.max())


def is_state(column: Column) -> bool:
    """Whether a column holds a flag or the numbers of a state: few whole numbers, none below zero."""
    numbers = np.unique(column.values[np.isfinite(column.values)])
    return len(numbers) <= _MOST_STATES and bool((numbers == np.round(numbers)).all() and numbers[0] >= 0)


def filled(column: Column) -> FloatArray:
    """Values (row,) held where none arrived, or a code for none."""
    values = column.values
    known = np.flatnonzero(np.isfinite(values) & ~codes(values))
    last = np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)
    return values[known[last]]


class _Motion:
    """Correlations of the columns: of the changes of each with the integrals of each, over spans of `SPANS_S`."""

    def __init__(self, clock: FloatArray, parts: list[slice], options: Mapping[str, list[Column]]) -> None:
        self.clock, self.parts = clock, parts
        self.columns = {column.name: column for signal in MOTION for column in options[signal]}
        self.number = {name: i for i, name in enumerate(self.columns)}
        values = [filled(column) for column in self.columns.values()]
        self.tables = [table for span in SPANS_S if (table := _table(clock, parts, values, span)) is not None]
        spans = [table[0].shape[-1] / 4 for table in self.tables]
        self.by_chance = math.tanh(_CHANCE / math.sqrt(min(spans) - 3)) if spans else 0.0
        """Size up to which a correlation may be chance, by how many spans lie side by side."""

    def same(self, signal: str, a: Column, b: Column) -> bool:
        """Whether two columns measure the same."""
        pick = 0 if signal == "speed" else 1
        i, j = self.number[a.name], self.number[b.name]
        found = [abs(float(table[pick][..., i, :].ravel() @ table[pick][..., j, :].ravel())) for table in self.tables]
        size = len(DELAYS_S) if pick else 1
        return max(found, default=0.0) / size > _ALIKE

    def correlation(self, level: Column, rate: Column) -> float | None:
        """Of changes of `level` and the integral of `rate`; None where the drive does not tell."""
        return self._best(0, level, rate, 1)

    def response(self, channel: str, answer: Column, command: Column) -> float | None:
        """Of the motion that `channel` measures and the integral of `command`, up to 1 s later."""
        return self._best(0 if channel == "speed" else 1, answer, command, len(DELAYS_S))

    def _best(self, pick: int, answer: Column, rate: Column, delays: int) -> float | None:
        i, j = self.number[answer.name], self.number[rate.name]
        found = [
            float(r)
            for table in self.tables
            for r in table[1][:delays, j] @ (table[0][i] if pick == 0 else table[1][0, i])
        ]
        if not found:
            return None
        # a periodic drive correlates as strongly, with the other sign, half a period off
        best = max(found, key=lambda r: (r > 0.5, abs(r)))
        calm = pick == 0 and all(table[2][i] < _CALM for table in self.tables)
        return None if calm and abs(best) < 0.5 else best

    def pairs(self, of: Mapping[str, Column | None]) -> Iterator[tuple[str, tuple[str, ...], float]]:
        """What the data say of an assignment: kind of pair, its signals and their correlation."""
        speed, accel, command = of["speed"], of["accel"], of["accel_cmd"]
        if speed is not None and accel is not None and (r := self.correlation(speed, accel)) is not None:
            yield "motion", ("speed", "accel"), r
        if command is not None:
            answers = (("speed", speed), ("accel", accel))
            found = [(r, name) for name, c in answers if c is not None and (r := self.response(name, c, command))]
            if found:
                r, name = max(found, key=lambda one: abs(one[0]))
                yield "response", (name, "accel_cmd"), r

    def strongest(self, signal: str, column: Column, of: Mapping[str, Column | None]) -> tuple[float, str | None]:
        """The strongest correlation of a signal with those of an assignment, and with which; 0 and None where the data
        do not tell."""
        found = [(r, names) for _, names, r in self.pairs({**of, signal: column}) if signal in names]
        r, names = max(found, key=lambda one: abs(one[0]), default=(0.0, ()))
        return r, next((name for name in names if name != signal), None)


def _table(
    clock: FloatArray, parts: list[slice], values: list[FloatArray], span: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Changes (column, start), integrals (delay, column, start), each of mean 0 and length 1, and the size of the
    changes as a share of the column's largest value (column,); None where the spans are too few."""
    last = DELAYS_S[-1]
    starts = [np.arange(clock[p][0] + last, clock[p][-1] - span, span / 4) for p in parts if p.stop - p.start > 2]
    if not values or sum(map(len, starts)) < 4 * MIN_SPANS:
        return None
    changes, integrals, sizes = [], [], []
    used = [part for part in parts if part.stop - part.start > 2]
    for x in values:
        change, by_delay = [], []
        for part, at in zip(used, starts, strict=True):
            t, y = clock[part], x[part]
            total = integral(t, y)
            change.append(np.interp(at + span, t, y) - np.interp(at, t, y))
            before = at - np.array(DELAYS_S)[:, None]
            by_delay.append(np.interp(before + span, t, total) - np.interp(before, t, total))
        both = np.concatenate(change)
        sizes.append(float(both.std()) / max(float(np.abs(x).max()), 1e-300))
        changes.append(_standard(both))
        integrals.append(_standard(np.concatenate(by_delay, 1)))
    return np.array(changes), np.array(integrals).transpose(1, 0, 2), np.array(sizes)


def _standard(x: FloatArray) -> FloatArray:
    """Rows of mean 0 and length 1; a constant one, of which rounding alone is left, becomes 0."""
    x = x - x.mean(-1, keepdims=True)
    size = np.sqrt((x**2).sum(-1, keepdims=True))
    return np.where(size > 1e-9 * (1 + np.abs(x).max()), x / np.maximum(size, 1e-300), 0.0)


def _evidence(kind: str, correlation: float) -> float:
    """Nats by which a correlation is likelier between the right columns than between others."""
    power = _STEEP[kind]
    return math.log(_LOST + (1 - _LOST) * (power + 1) * abs(correlation) ** power)


def _prior(signal: str, column: Column) -> float:
    alike = column.likeness.get(signal, 0.0)
    if alike > 1:
        return _OWN
    if alike > 0:
        return _NAMED * (1 + math.log(alike))
    return _OTHERWISE if column.likeness or means_otherwise(column.header) else 0.0


def _score(of: Mapping[str, Column | None], motion: _Motion) -> float:
    """Nats of an assignment over that of no column at all."""
    names = sum(_prior(signal, column) - _TAKEN for signal, column in of.items() if column is not None)
    return names + sum(_evidence(kind, r) for kind, _, r in motion.pairs(of))


def _promising(signal: str, options: Mapping[str, list[Column]], motion: _Motion) -> list[Column]:
    """Columns that a name tells, and the few others that go best with a column of another signal that a name tells."""
    named = [column for column in options[signal] if signal in column.likeness]
    others = {name: [c for c in options[name] if name in c.likeness][:_KEPT] for name in MOTION if name != signal}
    promise: dict[str, float] = {}
    for column in options[signal]:
        for name, columns in others.items():
            for other in columns:
                if signal not in column.likeness and other.name != column.name:
                    of = {**dict.fromkeys(MOTION), signal: column, name: other}
                    gain = sum(_evidence(kind, r) for kind, _, r in motion.pairs(of))
                    promise[column.name] = max(promise.get(column.name, -math.inf), gain)
    rest = [column for column in options[signal] if promise.get(column.name, -math.inf) > _TOLD]
    if signal == "accel_cmd":
        rest = [column for column in rest if _comes_first(column, others, motion)]
    return [*named, *sorted(rest, key=lambda column: -promise[column.name])[:_KEPT]]


def _comes_first(column: Column, others: Mapping[str, list[Column]], motion: _Motion) -> bool:
    """Whether a column without a name precedes the car's motion, as a command does and a second sensor does not."""
    clock = motion.clock
    for name, columns in others.items():
        for other in columns[:1]:
            y = slope_of(clock, filled(other)) if name == "speed" else filled(other)
            late = lateness(clock, motion.parts, filled(column), y)
            if late is not None and late.correlation > 0.5 and late.seconds <= 0:
                return False
    return True


def _choices(
    options: Mapping[str, list[Column]], motion: _Motion, given: Mapping[str, str]
) -> Iterator[tuple[float, dict[str, Column | None]]]:
    none: list[Column | None] = [None]
    for combination in product(*([*options[s], *(none if s not in given else [])] or none for s in MOTION)):
        names = [column.name for column in combination if column is not None]
        if len(set(names)) == len(names):
            of: dict[str, Column | None] = dict(zip(MOTION, combination, strict=True))
            yield _score(of, motion), of


def _question(signal: str, choices: list[tuple[float, dict[str, Column | None]]], motion: _Motion) -> str | None:
    """A sentence where another column may be the signal as well, or one is named so and does not move so."""
    score, best = choices[0]
    column = best[signal]
    rest = {name: one for name, one in best.items() if name != signal}
    said = "its name" if column is not None and signal in column.likeness else "how it moves"
    if column is None:
        # with the others as they are: what its name says, or its motion, was not enough
        near = [
            (s, of[signal]) for s, of in choices if all(of[n] is c for n, c in rest.items()) and of[signal] is not None
        ]
        named = [c for _, c in near if c is not None and signal in c.likeness]
        # a second sensor moves as a command does, so of commands a name that says otherwise is believed
        moved = [c for _, c in near if c is not None and signal not in c.likeness and signal != "accel_cmd"]
        words = [f"{c.name} is named so but moves otherwise ({_with(signal, c, best, motion)})" for c in named[:2]]
        words += [f"{c.name} moves so ({_with(signal, c, best, motion)}) but is named otherwise" for c in moved[:1]]
        return f"which column is {signal}? {'; '.join(words)}; name it with --map {signal}=COLUMN" if words else None
    for other_score, of in choices[1:]:
        other = of[signal]
        if score - other_score > PLAIN:
            break
        if other is None or other is column or motion.same(signal, column, other):
            continue
        if signal not in other.likeness and abs(motion.strongest(signal, other, of)[0]) < motion.by_chance:
            continue
        return (
            f"which column is {signal}? {column.name} by {said} ({_with(signal, column, best, motion)}), or "
            f"{other.name} ({_with(signal, other, of, motion)}); name it with --map {signal}=COLUMN"
        )
    return None


def _with(signal: str, column: Column, of: Mapping[str, Column | None], motion: _Motion) -> str:
    """How a column goes with the other signals, in words."""
    r, other = motion.strongest(signal, column, of)
    return f"correlation {r:.2f} with {other}" if other else "nothing else in the log tells"


def _reasons(signal: str, column: Column, best: Mapping[str, Column | None], motion: _Motion, given: bool) -> list[str]:
    if given:
        return ["as given"]
    if signal not in column.likeness:
        words = {
            "speed": "its change is the integral of the acceleration",
            "accel": "its integral is the change of speed",
            "accel_cmd": "the car's motion follows it",
        }[signal]
        return [f"no name tells; {words} (correlation {abs(motion.strongest(signal, column, best)[0]):.2f})"]
    return [column.by_what]


def _one_sided(values: FloatArray) -> bool:
    """Whether values (row,) have one sign all along and no zero among the usual ones: a pedal's way, a torque."""
    low, high = np.quantile(values, (0.01, 0.99))
    return bool(low > 0 or high < 0)


def _unit_of_accel(column: Column) -> str | None:
    unit = column.header.unit or bare_unit(column.header, "accel")
    return unit if unit in _ACCELS else None
