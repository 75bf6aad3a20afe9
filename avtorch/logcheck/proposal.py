"""Which columns of a log are which signals, and in which units: a proposal, each part of it with its reason."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import printable
from avtorch.io.bad_rows import MOST_BAD, codes
from avtorch.io.consistency import scale_between
from avtorch.io.mapping import PEDALS
from avtorch.io.segments import gap_limit, stretches
from avtorch.io.tables import Table
from avtorch.io.unit_names import stated_unit
from avtorch.logcheck.candidates import Column, columns_of, ranked
from avtorch.logcheck.header import bare_unit
from avtorch.logcheck.joint_units import UnitTest, factor, units_together
from avtorch.logcheck.order_of_events import lateness

_MOTION = ("accel_cmd", "accel", "speed")
_COMMANDS = (*PEDALS, "speed_cmd")
_MOST_SHARE, _MOST_PERCENT = 1.2, 120.0  # of a pedal's way; it may be calibrated a little wrongly
_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_RATES_HZ = (9.5, 210.0)
_LARGEST = 1e9  # of a speed or an acceleration, in any unit
_TRIED = 60  # columns without a telling name that are compared with the others
_MOST_STATES = 8  # numbers of a column that says who drives
_ONE_MOTION, _FOLLOWS = 0.9, 0.8  # correlations from which a column without a name is taken
# a response that comes so long before its command, and so many rows, by so much more correlation
_EARLY_S, _EARLY_ROWS, _PLAINLY = 0.08, 2.0, 0.01


@dataclass(frozen=True)
class Proposed:
    """A signal's `column`, its `unit` (as `--unit` takes it; None: as the file says, or SI), whether it is written only
    where it `arrives`, the `reason` for all of it, and `when`, numbers of a state that mean yes."""

    column: str
    unit: str | None
    arrives: bool
    reason: str
    when: tuple[int, ...] = ()


@dataclass(frozen=True)
class Proposal:
    """Signals by name, and what remains in doubt, in sentences."""

    signals: Mapping[str, Proposed]
    doubts: tuple[str, ...] = ()

    @property
    def map(self) -> dict[str, str]:
        """What `Log.read` takes as its `map`: columns that do not bear the signal's own name."""
        return {signal: one.column for signal, one in self.signals.items() if one.column != signal}

    @property
    def unit(self) -> dict[str, str]:
        return {signal: one.unit for signal, one in self.signals.items() if one.unit is not None}

    @property
    def stamp(self) -> dict[str, str]:
        clock = self.signals["time"].column if "time" in self.signals else "time"
        return {signal: clock for signal, one in self.signals.items() if one.arrives}

    @property
    def state(self) -> dict[str, str]:
        return {signal: ",".join(map(str, one.when)) for signal, one in self.signals.items() if one.when}

    @property
    def needed(self) -> bool:
        """Whether the log is read otherwise without it."""
        return bool(self.map or self.unit or self.stamp or self.state)

    @property
    def options(self) -> dict[str, dict[str, str]]:
        """Arguments of `Log.read`, which are the tables of the file beside the log."""
        return {"map": self.map, "unit": self.unit, "stamp": self.stamp, "state": self.state}

    def toml(self, name: str) -> str:
        """The file beside the log `name` that says all this, with the reasons as comments."""
        lines = [f"# How to read {printable(name, 100)}; proposed by `avtorch check`, which gives these reasons."]
        for table, entries in self.options.items():
            if entries:
                lines += ["", f"[{table}]"]
            for signal, value in entries.items():
                lines.append(f"{signal} = {_toml_text(value)}  # {printable(self.signals[signal].reason, 200)}")
        return "\n".join(lines) + "\n"


def _toml_text(text: str) -> str:
    """A basic string of TOML: JSON's, with characters beyond 16 bits as they are and DEL escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def propose(table: Table) -> Proposal:
    """Names and units of the signals of a table."""
    columns = columns_of(table)
    time, clock = _time(columns)
    if time is None or clock is None:
        return Proposal({}, ("no column rises from row to row at 10 to 200 Hz as a time does",))
    known = np.flatnonzero(np.isfinite(clock))
    found: dict[str, Column] = {}
    reasons: dict[str, list[str]] = {}
    parts = _parts(clock)
    left = [column for column in columns if column.name != time.column]
    for signal in _MOTION:
        _by_name(signal, left, found, reasons)
    doubts: list[str] = []
    _by_motion(clock, parts, left, found, reasons, doubts)
    _swapped(clock, parts, found, reasons)
    units = _units(clock, parts, found, reasons, doubts)
    signals = {"time": time}
    for signal in _MOTION:
        if signal in found:
            signals[signal] = _proposed(found[signal], units.get(signal), reasons[signal], known)
        elif signal == "accel_cmd" and not any(ranked(left, name) for name in _COMMANDS):
            doubts.append("no column looks like the commanded acceleration; name it with --map accel_cmd=COLUMN")
    if "accel" not in found and "speed" not in found:
        doubts.append("no column looks like the car's speed or acceleration; name one with --map speed=COLUMN")
    used = {one.column for one in signals.values()}
    left = [column for column in left if column.name not in used]
    for signal, one in _others(left, signals, found, known).items():
        signals[signal] = one
    if "engaged" not in signals:
        doubts += _states(left)
    return Proposal(signals, tuple(doubts))


def _states(columns: list[Column]) -> list[str]:
    """Columns named as one that says who drives, whose numbers may be states: which of them means the controller?"""
    doubts = []
    for column in ranked(columns, "engaged"):
        numbers = np.unique(column.values[np.isfinite(column.values)])
        if 2 <= len(numbers) <= _MOST_STATES and (numbers == np.round(numbers)).all():
            name, told = printable(column.name, 30), ", ".join(f"{x:g}" for x in numbers)
            where = "with --map engaged=COLUMN and in the file beside the log, under [state], the numbers that mean it"
            doubts.append(f"{name} ({told}) may say when the controller drives; if so, name it {where}")
    return doubts


def _time(columns: list[Column]) -> tuple[Proposed | None, FloatArray | None]:
    """The clock: of the columns that rise at a rate a log can have, the one whose name fits best; seconds (row,)."""
    named = ranked(columns, "time")
    for column in [*named, *(c for c in columns if c not in named)]:
        values = column.values[np.isfinite(column.values)]
        steps = np.diff(values)
        if len(steps) < 2 or (steps > 0).mean() < 1 - 2 * MOST_BAD:
            continue
        step = float(np.median(steps[steps > 0]))
        fitting = [unit for unit, ticks in _TICKS.items() if _RATES_HZ[0] <= ticks / step <= _RATES_HZ[1]]
        stated = column.header.unit or bare_unit(column.header, "time")
        if not fitting or (not named and np.ptp(steps) > 10 * step):
            continue
        unit = stated if stated in fitting else fitting[0]
        why = "by its name" if column in named else "no name tells; it rises evenly"
        if unit != "s":
            why += f", in {unit}: rows come at {_TICKS[unit] / step:.4g} Hz"
            if stated is not None and stated != unit:
                why += f", which its {stated} would not give"
        return Proposed(column.name, None if unit == "s" else unit, False, why), column.values / _TICKS[unit]
    return None, None


def _parts(clock: FloatArray) -> list[slice]:
    steps = np.diff(clock)
    usual = float(np.nanmedian(steps[steps > 0])) if (steps > 0).any() else 1.0
    broken = np.concatenate([[False], ~((steps > 0) & (steps <= gap_limit(usual)))])
    good: BoolArray = np.isfinite(clock)
    return stretches(good, np.cumsum(broken).astype(np.int64))


def _by_name(signal: str, columns: list[Column], found: dict[str, Column], reasons: dict[str, list[str]]) -> None:
    taken = {column.name for column in found.values()}
    named = [column for column in ranked(columns, signal) if column.name not in taken and _moves(column)]
    if named:
        found[signal], reasons[signal] = named[0], [_by_what(named[0])]
        others = [c.name for c in named[1:] if c.likeness[signal] > 0.9 * named[0].likeness[signal]]
        if others:
            reasons[signal].append(f"as well as {', '.join(printable(name, 30) for name in others)}")


def _by_what(column: Column) -> str:
    return f"by the layout of {column.layout}" if column.layout else "by its name"


def _by_motion(
    clock: FloatArray, parts: list[slice], columns: list[Column], found: dict[str, Column],
    reasons: dict[str, list[str]], doubts: list[str],
) -> None:  # fmt: skip
    """Signals that no name tells, by how they go with the others.

    A car's log holds many columns that go with its speed; one more acceleration is taken only with its unit.
    """
    for signal in ("speed", "accel", "accel_cmd"):
        if signal in found:
            continue
        taken = {column.name for column in found.values()}
        rest = [c for c in columns if c.name not in taken and not c.likeness and _moves(c)][:_TRIED]
        if signal == "accel":
            rest = [c for c in rest if c.header.unit in ("m/s2", "g", "mg", "cm/s2", "ft/s2")]
        best, strength = None, 0.0
        for column in rest:
            how_much = _goes_with(signal, _filled(column), clock, parts, found)
            if how_much > strength:
                best, strength = column, how_much
        if best is not None and strength > (_FOLLOWS if signal == "accel_cmd" else _ONE_MOTION):
            if signal == "accel_cmd" and _one_sided(_filled(best)):
                doubts.append(
                    f"the car's motion follows {printable(best.name, 30)} (correlation {strength:.2f}), which is never "
                    "about zero as an acceleration is; name it with --map throttle=COLUMN, torque=COLUMN or what it is"
                )
                continue
            words = {
                "speed": "its change is the integral of the acceleration",
                "accel": "its integral is the change of speed",
                "accel_cmd": "the car's motion follows it",
            }[signal]
            found[signal] = best
            reasons[signal] = [f"no name tells; {words} (correlation {strength:.2f})"]


def _one_sided(values: FloatArray) -> bool:
    """Whether values (row,) have one sign all along and no zero among the usual ones: a pedal's way, a torque."""
    low, high = np.quantile(values, (0.01, 0.99))
    return bool(low > 0 or high < 0)


def _goes_with(
    signal: str, values: FloatArray, clock: FloatArray, parts: list[slice], found: Mapping[str, Column]
) -> float:
    """Correlation of a column with the motion that is known, as that signal."""
    if signal == "accel_cmd":
        motion = _motion(clock, found)
        late = None if motion is None else lateness(clock, parts, values, motion)
        return late.correlation if late is not None and late.seconds > 0 else 0.0
    other = "accel" if signal == "speed" else "speed"
    if other not in found:
        return 0.0
    pair = (values, _filled(found[other])) if signal == "speed" else (_filled(found[other]), values)
    scale = scale_between(clock, parts, *pair)
    return 0.0 if scale is None else abs(scale.correlation)


def _motion(clock: FloatArray, found: Mapping[str, Column]) -> FloatArray | None:
    """The acceleration of the car: the slope of its speed over half a second, whose sign is sure, or measured."""
    if "speed" in found:
        speed = _filled(found["speed"])
        return np.interp(clock + 0.25, clock, speed) - np.interp(clock - 0.25, clock, speed)
    return _filled(found["accel"]) if "accel" in found else None


def _swapped(clock: FloatArray, parts: list[slice], found: dict[str, Column], reasons: dict[str, list[str]]) -> None:
    """Exchanges command and acceleration where what is called the response comes first."""
    if "accel_cmd" not in found or "accel" not in found:
        return
    late = lateness(clock, parts, _filled(found["accel_cmd"]), _filled(found["accel"]))
    early = max(_EARLY_S, _EARLY_ROWS * float(np.nanmedian(np.diff(clock))))
    if late is None or late.correlation < _FOLLOWS or late.seconds > -early or late.lead < _PLAINLY:
        return
    found["accel_cmd"], found["accel"] = found["accel"], found["accel_cmd"]
    words = f"named the other way round, but what is called the response comes {-late.seconds:.2f} s first"
    reasons["accel_cmd"], reasons["accel"] = [words], [words]


def _units(
    clock: FloatArray, parts: list[slice], found: Mapping[str, Column], reasons: dict[str, list[str]],
    doubts: list[str],
) -> dict[str, str]:  # fmt: skip
    if not found:
        return {}
    stated = {signal: _stated(signal, column) for signal, column in found.items()}
    test = units_together(clock, {signal: _filled(column) for signal, column in found.items()}, stated, parts)
    units: dict[str, str] = {}
    for signal, unit in test.best.units.items():
        turned = signal in test.best.turned
        told = stated[signal]
        # the file states it, so a table need not say it again, unless it is wrong
        if unit not in ("m/s", "m/s2") or turned or told not in (unit, None):
            units[signal] = f"{-factor(signal, unit):.10g}" if turned else unit
        words = []
        if told == unit and found[signal].name == signal:
            pass
        elif told == unit:
            words.append(f"in {unit} by its header")
        elif told is not None:
            words.append(f"in {unit}, not the {told} of its header: {_proof(signal, test)}")
        elif unit not in ("m/s", "m/s2"):
            words.append(f"in {unit}: {_proof(signal, test)}")
        if turned:
            words.append("with its sign reversed, as the motion has the other one")
        reasons[signal] += words
    if test.rival is not None:
        best, rival = test.best, test.rival
        differ = [
            f"{signal} in {rival.units[signal]}{' reversed' if signal in rival.turned else ''}"
            for signal in best.units
            if rival.units[signal] != best.units[signal] or (signal in rival.turned) != (signal in best.turned)
        ]
        doubts.append(f"the data allow {' with '.join(differ)} nearly as well")
    return units


def _stated(signal: str, column: Column) -> str | None:
    """The unit of a header; a column that bears a signal's own name is in SI as far as it says."""
    si = ("m/s" if signal == "speed" else "m/s2") if column.name == signal else None
    return column.header.unit or bare_unit(column.header, signal) or si


def _proof(signal: str, test: UnitTest) -> str:
    """What of the data decides a unit."""
    for (level, rate), scale in test.scales.items():
        if signal in (level, rate):
            sizes = factor(level, test.best.units[level]) / factor(rate, test.best.units[rate])
            return f"{level} then changes {abs(scale.slope) * sizes:.2f} times as {rate} says"
    return "its size is then a car's"


def _proposed(column: Column, unit: str | None, reasons: list[str], known: np.ndarray) -> Proposed:
    empty = float(np.isnan(column.values[known]).mean())
    if empty > MOST_BAD:
        reasons = [*reasons, f"written in {1 - empty:.0%} of the rows: held between arrivals"]
    return Proposed(column.name, unit, empty > MOST_BAD, ", ".join(reasons))


def _others(
    columns: list[Column], signals: Mapping[str, Proposed], found: Mapping[str, Column], known: np.ndarray
) -> dict[str, Proposed]:
    """Signals besides the motion, by name and by what values they can have."""
    out: dict[str, Proposed] = {}
    for signal in ("engaged", "spacing", "lead_speed", "lead_accel", "grade", "segment", *_COMMANDS):
        for column in ranked(columns, signal):
            values = column.values[np.isfinite(column.values)]
            # beside an acceleration they are not needed; one that bears the signal's name is read in any case
            if signal in _COMMANDS and "accel_cmd" in signals and column.name != signal:
                continue
            if any(column.name == one.column for one in out.values()) or not (column.when or _can_be(signal, values)):
                continue
            unit = _unit_besides(signal, column, signals, found)
            reasons = [_by_what(column)] + ([f"in {unit}"] if unit else [])
            out[signal] = replace(_proposed(column, unit, reasons, known), when=column.when)
            break
    return out


def _can_be(signal: str, values: FloatArray) -> bool:
    if signal == "engaged":
        return set(np.unique(values)) <= {0.0, 1.0} and bool((values == 1).any())
    if signal == "segment":
        return len(np.unique(values)) <= max(2, len(values) // 20) and bool((values == np.round(values)).all())
    if signal == "spacing":
        return float(np.quantile(values, 0.05)) >= 0 and float(values.max()) > 0
    return bool(np.ptp(values) > 0)


def _unit_besides(
    signal: str, column: Column, signals: Mapping[str, Proposed], found: Mapping[str, Column]
) -> str | None:
    stated = column.header.unit
    if signal in _COMMANDS:
        return _unit_of_command(signal, column)
    if signal == "lead_speed" and "speed" in found and "speed" in signals:
        # it goes about as fast as the car behind it
        ego = np.nanmean(np.abs(found["speed"].values)) * factor("speed", signals["speed"].unit or "m/s")
        lead = float(np.nanmean(np.abs(column.values)))
        fits = [u for u in ("m/s", "km/h", "mph") if 0.75 < lead * factor("speed", u) / max(ego, 1e-9) < 1.3]
        unit = stated if stated in fits or not fits else fits[0]
        return None if unit == "m/s" else unit
    if signal == "lead_accel" and stated is None:
        return signals["accel"].unit if "accel" in signals else None
    known = {"spacing": ("cm", "mm", "km", "ft"), "grade": ("%", "deg", "rad"), "lead_accel": ("g", "cm/s2", "ft/s2")}
    return stated if stated in known.get(signal, ()) else None


def _moves(column: Column) -> bool:
    """Whether a column changes, by numbers that a car's motion can have in any unit."""
    values = column.values[np.isfinite(column.values)]
    return bool(np.abs(values).max() < _LARGEST and values.min() < values.max())


def _unit_of_command(signal: str, column: Column) -> str | None:
    """Of a pedal, torque, current or speed that is commanded: as stated, or percent where no share is so large."""
    unit = column.header.unit or bare_unit(column.header, signal)
    if unit is not None:
        known = stated_unit(signal, unit)
        return None if known in (None, "m/s", "Nm", "A", "Pa") else known
    top = float(np.nanmax(np.abs(column.values)))
    return "%" if signal in ("throttle", "brake") and _MOST_SHARE < top <= _MOST_PERCENT else None


def _filled(column: Column) -> FloatArray:
    """Values (row,) held where none arrived, or a code for none."""
    values = column.values
    known = np.flatnonzero(np.isfinite(values) & ~codes(values))
    last = np.maximum(np.searchsorted(known, np.arange(len(values)), side="right") - 1, 0)
    return values[known[last]]
