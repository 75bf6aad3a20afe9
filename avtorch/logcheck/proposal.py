"""Which columns of a log are which signals, and in which units: a proposal, each part of it with its reason."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import printable
from avtorch.io.clock import gap_limit, stretches
from avtorch.io.mapping import PEDALS, Pairs, SignalMap, given_mapping
from avtorch.io.tables import Table
from avtorch.io.units import factor, stated_unit
from avtorch.io.validity import DELAYS_S, MOST_BAD, Scale, integral, late_response, scale_between
from avtorch.logcheck.assignment import MOTION, PLAIN, Column, assign, columns_of, filled, is_state, moves, ranked
from avtorch.logcheck.recorder import lateness
from avtorch.logcheck.vocabulary import NAMED_SIGNALS, bare_unit, header_of, is_answer, is_asked, likeness

DRIVES = ("throttle", "torque", "current", "speed_cmd")
"""Commands of which one drives the car, those nearest to the actuator first."""
COMMANDS = (*PEDALS, "speed_cmd")
_MOST_SHARE, _MOST_PERCENT = 1.2, 120.0  # of a pedal's way; it may be calibrated a little wrongly


def commands_of(columns: list[Column], given: Collection[str], commanded: bool) -> tuple[dict[str, Column], list[str]]:
    """Commands by signal, and doubts; `commanded`: an acceleration is, beside which only what bears the very name of a
    command is read; `given`: signals that the user named."""
    may: dict[str, list[Column]] = {
        signal: [c for c in ranked(columns, signal) if moves(c) and (not is_state(c) or c.name == signal)]
        for signal in COMMANDS
        if signal not in given
    }
    found = {signal: own[0] for signal, some in may.items() if (own := [c for c in some if c.likeness[signal] > 1])}
    if commanded:
        return found, []
    if not {*found, *given} & set(DRIVES):
        drives = [signal for signal in DRIVES if may[signal]]
        # what says that it is asked for comes before what may be an answer
        drives.sort(key=lambda signal: (not is_asked(may[signal][0].header), is_answer(may[signal][0].header)))
        found |= {signal: may[signal][0] for signal in drives[:1]}
    if may.get("brake"):
        found.setdefault("brake", next((c for c in may["brake"] if c not in found.values()), may["brake"][0]))
    used = [column.name for column in found.values()]
    left: dict[str, str] = {}
    for signal, some in may.items():
        for column in some:
            if column.name not in used and not is_answer(column.header):
                left.setdefault(column.name, signal)
    if len(used) != len(set(used)):  # one column for two commands
        found.pop("brake")
    doubts = [
        f"{name} may command the car as well, or be its answer; if the car obeys it, name it with --map {signal}=COLUMN"
        for name, signal in left.items()
        if found or given
    ]
    return found, doubts


def unit_of_command(signal: str, column: Column) -> tuple[str | None, str | None]:
    """The unit of a command, None for SI, and a doubt: as stated, else by its size; negative where less is more."""
    stated = column.header.unit or bare_unit(column.header, signal)
    unit, doubt = (stated_unit(signal, stated) if stated else None), None
    values = column.values[np.isfinite(column.values)]
    top = float(np.abs(values).max())
    if unit is None and signal in ("throttle", "brake") and top > _MOST_SHARE:
        if signal == "brake" and "torque" in column.header.words:
            unit = "Nm"
        elif top <= _MOST_PERCENT:
            unit = "%"
        elif signal == "brake":
            doubt = (
                f"{column.name} reaches {top:.4g}: say with --unit brake=kPa, --unit brake=Nm or another unit whether "
                "it is a pressure or a torque"
            )
    if signal == "brake" and float(np.quantile(values, 0.99)) <= 0 > float(values.min()):
        return f"{-factor(signal, unit or '1'):.10g}", doubt
    return (None if unit in (None, "m/s", "A", "Pa") or (unit == "Nm" and signal == "torque") else unit), doubt


_TICKS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
_RATES_HZ = (9.5, 210.0)
_FOLLOWS = 0.8  # correlation of a response with its command from which their order means something
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


def propose(table: Table, *, map: Pairs = None, unit: Pairs = None) -> Proposal:
    """Names and units of the signals of a table; `map` and `unit` name some of them, as `Log.read` takes them."""
    stated = given_mapping(SignalMap(), map=map, unit=unit)
    given = stated.column
    columns = columns_of(table)
    found_clock = _time([c for c in columns if c.name == given.get("time", c.name)])
    if found_clock is None:
        return Proposal({}, (_no_time(table),))
    time, clock = found_clock
    known = np.flatnonzero(np.isfinite(clock))
    parts = _parts(clock)
    doubts: list[str] = _twice(table)
    left = [column for column in columns if column.name != time.column]
    found, reasons, asked = assign(clock, parts, left, {signal: given[signal] for signal in MOTION if signal in given})
    doubts += asked
    if not {"accel_cmd", "accel"} & set(given):
        _swapped(clock, parts, found, reasons)
    units = _units(clock, parts, found, reasons, doubts)
    signals = {"time": time}
    signals |= {s: _proposed(found[s], units.get(s), reasons[s], known) for s in MOTION if s in found}
    if "accel" not in found and "speed" not in found:
        doubts.append("no column looks like the car's speed or acceleration; name one with --map speed=COLUMN")
    used = {one.column for one in signals.values()} | set(given.values())
    left = [column for column in left if column.name not in used]
    commands, asked = commands_of(left, given, "accel_cmd" in {**signals, **given})
    doubts += asked
    for signal, column in commands.items():
        unit_of, doubt = unit_of_command(signal, column)
        reason = [column.by_what, *([f"in {unit_of}"] if unit_of else [])]
        signals[signal] = _proposed(column, unit_of, reason, known)
        doubts += [] if doubt is None or signal in stated.unit else [doubt]
    signals |= _others(left, {**signals, **dict.fromkeys(given)}, signals, found, known)
    if not {"accel_cmd", *COMMANDS} & {*signals, *given} and not any("accel_cmd=" in doubt for doubt in doubts):
        doubts.append("no column looks like the commanded acceleration; name it with --map accel_cmd=COLUMN")
    if "engaged" not in signals:
        doubts += _states(left)
    for signal in {**given, **stated.unit}:
        one = signals.get(signal) or Proposed(given.get(signal, signal), None, False, "as given")
        signals[signal] = replace(one, unit=stated.unit.get(signal, one.unit))
    return Proposal(signals, tuple(doubts))


def _twice(table: Table) -> list[str]:
    """Names that several columns have, of which none can be told from the other."""
    names = [name for name in dict.fromkeys(table.names) if table.names.count(name) > 1]
    told = [name for name in names if any(likeness(header_of(name), signal) for signal in NAMED_SIGNALS)]
    return [f"{table.names.count(name)} columns are called {name}; rename all but the right one" for name in told]


def _no_time(table: Table) -> str:
    """What is wrong with the column that is named as the clock."""
    for name in dict.fromkeys(table.names):
        if likeness(header_of(name), "time") and table.names.count(name) == 1:
            faults = table.readings(name, as_time=True).faults
            if len(faults) > MOST_BAD * table.rows:
                return faults[min(faults)].removeprefix(f"{table.source}: ")
    return "no column rises from row to row at 10 to 200 Hz as a time does"


def _states(columns: list[Column]) -> list[str]:
    """Columns named as one that says who drives, whose numbers may be states: which of them means the controller?"""
    doubts = []
    for column in ranked(columns, "engaged"):
        numbers = np.unique(column.values[np.isfinite(column.values)])
        if len(numbers) >= 2 and is_state(column):
            name, told = column.name, ", ".join(f"{x:g}" for x in numbers)
            where = "with --map engaged=COLUMN and in the file beside the log, under [state], the numbers that mean it"
            doubts.append(f"{name} ({told}) may say when the controller drives; if so, name it {where}")
    return doubts


def _time(columns: list[Column]) -> tuple[Proposed, FloatArray] | None:
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
    return None


def _parts(clock: FloatArray) -> list[slice]:
    steps = np.diff(clock)
    usual = float(np.nanmedian(steps[steps > 0])) if (steps > 0).any() else 1.0
    broken = np.concatenate([[False], ~((steps > 0) & (steps <= gap_limit(usual)))])
    good: BoolArray = np.isfinite(clock)
    return stretches(good, np.cumsum(broken).astype(np.int64))


def _swapped(clock: FloatArray, parts: list[slice], found: dict[str, Column], reasons: dict[str, list[str]]) -> None:
    """Exchanges command and acceleration where what is called the response comes first."""
    if "accel_cmd" not in found or "accel" not in found:
        return
    late = lateness(clock, parts, filled(found["accel_cmd"]), filled(found["accel"]))
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
    best, rival, scales = units_together(clock, {signal: filled(c) for signal, c in found.items()}, stated, parts)
    units: dict[str, str] = {}
    for signal, (unit, turned) in best.items():
        told = stated[signal]
        # the file states it, so a table need not say it again, unless it is wrong
        if unit not in ("m/s", "m/s2") or turned or told not in (unit, None):
            units[signal] = f"{-factor(signal, unit):.10g}" if turned else unit
        if told == unit:
            reasons[signal] += [] if found[signal].name == signal else [f"in {unit} by its header"]
        elif told is not None:
            reasons[signal].append(f"in {unit}, not the {told} of its header: {_proof(signal, best, scales)}")
        elif unit not in ("m/s", "m/s2"):
            reasons[signal].append(f"in {unit}: {_proof(signal, best, scales)}")
        if turned:
            reasons[signal].append("with its sign reversed, as the motion has the other one")
    if rival is not None:
        differ = [
            f"{signal} in {unit}{' reversed' if turned else ''}"
            for signal, (unit, turned) in rival.items()
            if (unit, turned) != best[signal]
        ]
        doubts.append(f"the data allow {' with '.join(differ)} nearly as well")
    return units


def _stated(signal: str, column: Column) -> str | None:
    """The unit of a header; a column that bears a signal's own name is in SI as far as it says."""
    si = ("m/s" if signal == "speed" else "m/s2") if column.name == signal else None
    return column.header.unit or bare_unit(column.header, signal) or si


def _proof(signal: str, units: Units, scales: Scales) -> str:
    """What of the data decides a unit."""
    for (level, rate), scale in scales.items():
        if signal in (level, rate):
            sizes = factor(level, units[level][0]) / factor(rate, units[rate][0])
            return f"{level} then changes {abs(scale.slope) * sizes:.2f} times as {rate} says"
    return "its size is then a car's"


def _proposed(column: Column, unit: str | None, reasons: list[str], known: np.ndarray) -> Proposed:
    empty = float(np.isnan(column.values[known]).mean())
    if empty > MOST_BAD:
        reasons = [*reasons, f"written in {1 - empty:.0%} of the rows: held between arrivals"]
    return Proposed(column.name, unit, empty > MOST_BAD, ", ".join(reasons))


def _others(
    columns: list[Column],
    there: Collection[str],
    signals: Mapping[str, Proposed],
    found: Mapping[str, Column],
    known: np.ndarray,
) -> dict[str, Proposed]:
    """Signals besides motion and commands that are not `there`, by name and by what values they can have."""
    out: dict[str, Proposed] = {}
    used = {one.column for one in signals.values()}
    for signal in ("engaged", "spacing", "lead_speed", "lead_accel", "grade", "segment"):
        for column in ranked(columns, signal) if signal not in there else ():
            values = column.values[np.isfinite(column.values)]
            if column.name in used or not (column.when or _can_be(signal, values)):
                continue
            unit = _unit_besides(signal, column, signals, found)
            reasons = [column.by_what] + ([f"in {unit}"] if unit else [])
            out[signal] = replace(_proposed(column, unit, reasons, known), when=column.when)
            used.add(column.name)
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


# Units of command, acceleration and speed are tested together: km/h with g fits each of them alone as well as m/s with
# m/s². Together only one choice makes the change of speed the integral of the acceleration, and both the answer to the
# command. What the headers state counts, too, but less than a plain contradiction by the data: a header can be wrong.
# natural logarithms of how much rarer a unit is than SI in logs of cars
_SPEED_UNITS = {"m/s": 0.0, "km/h": 0.5, "mph": 1.0, "kn": 4.0, "ft/s": 4.0, "cm/s": 4.0, "mm/s": 5.0}
_ACCEL_UNITS = {"m/s2": 0.0, "g": 0.7, "km/h/s": 3.0, "mg": 3.0, "cm/s2": 4.0, "ft/s2": 4.5, "mm/s2": 5.0}
_STATED = 2.5  # nats that a header's unit is worth
_TURNED = 4.0  # nats that a sensor mounted backwards costs
_ALIKE = 1.0  # nats that one unit for command and acceleration is worth
_SAME_MOTION = 0.12  # spread of the logarithm of their scale where two channels measure one motion
# recordings exist whose acceleration is 1.8 times the slope of their speed: one in ten is taken to have such a channel
_MISCALIBRATED, _SHARE = 0.3, 0.1
_RESPONSE, _GAIN = 0.35, 0.95  # the same of a car's answer to its command, and its middle
_WORST = 40.0
_SURE = 0.7  # correlation from which a scale says something
_SPEED_MPS, _SPEED_SPREAD = 35.0, 8.0  # of the 99th percentile, above which speeds are rare
_ACCEL_MPS2, _ACCEL_SPREAD = 0.8, 1.2


Units = Mapping[str, tuple[str, bool]]
"""By signal its unit, as `avtorch.io.units` names it, and whether its sign is reversed."""
Scales = Mapping[tuple[str, str], Scale]
"""By two signals: change of the first per integral of the second."""


def units_together(
    time: FloatArray, signals: Mapping[str, FloatArray], stated: Mapping[str, str | None], parts: list[slice]
) -> tuple[Units, Units | None, Scales]:
    """The best units of `signals` (row,), of `accel_cmd`, `accel` and `speed` those that are there; the next best ones
    where the data do not rule them out; and the scales, in the signals' own units, that both rest on.

    `time` (row,) [s]; `stated`: what headers say; `parts`: stretches of rows that may be compared.
    """
    scales = _scales(time, signals, parts)
    options: dict[str, list[tuple[tuple[str, bool], float]]] = {}
    for name, values in signals.items():
        options[name] = []
        for unit, rare in (_SPEED_UNITS if name == "speed" else _ACCEL_UNITS).items():
            told = stated.get(name)
            cost = (rare if told is None else 0.0 if unit == told else _STATED + rare) + _by_size(name, values, unit)
            options[name] += [((unit, False), cost)] + ([] if name == "speed" else [((unit, True), cost + _TURNED)])
    choices: list[tuple[float, Units]] = []
    for combination in product(*options.values()):
        units = {name: unit for name, (unit, _) in zip(options, combination, strict=True)}
        cost = sum(cost for _, cost in combination) + _by_motion(units, scales)
        both = [units[name][0] for name in ("accel_cmd", "accel") if name in units]
        if len(both) == 2 and both[0] == both[1]:
            cost -= _ALIKE
        choices.append((cost, units))
    (least, best), *others = sorted(choices, key=lambda choice: choice[0])
    return best, next((units for cost, units in others if cost < least + PLAIN), None), scales


def _scales(time: FloatArray, signals: Mapping[str, FloatArray], parts: list[slice]) -> Scales:
    found: dict[tuple[str, str], Scale | None] = {}
    if "speed" in signals and "accel" in signals:
        found["speed", "accel"] = scale_between(time, parts, signals["speed"], signals["accel"])
    for name in ("speed", "accel") if "accel_cmd" in signals else ():
        if name in signals:
            level = signals[name] if name == "speed" else integral(time, signals[name])
            found[name, "accel_cmd"] = _response(time, parts, level, signals["accel_cmd"])
    return {pair: x for pair, x in found.items() if x is not None and abs(x.correlation) >= _SURE and x.slope != 0}


def _response(time: FloatArray, parts: list[slice], level: FloatArray, u: FloatArray) -> Scale | None:
    found = scale_between(time, parts, level, u, delays=DELAYS_S)
    if found is not None and found.slope < 0 and late_response(time, parts, level, u)[1]:
        return None  # inverted, or late by half a period: the data cannot tell
    return found


def _by_motion(units: Units, scales: Scales) -> float:
    cost = 0.0
    for (level, rate), scale in scales.items():
        signed = scale.slope * factor(level, units[level][0]) / factor(rate, units[rate][0])
        signed *= -1.0 if units[level][1] != units[rate][1] else 1.0
        weight = scale.correlation**2
        if signed <= 0:
            cost += _WORST * weight
        elif (level, rate) == ("speed", "accel"):
            cost += weight * min(_WORST, _off_motion(math.log(signed)))
        else:
            cost += weight * min(_WORST, 0.5 * (math.log(signed / _GAIN) / _RESPONSE) ** 2)
    return cost


def _off_motion(off: float) -> float:
    """What a scale costs that is `off` 1 by its logarithm, of two channels that measure one motion."""
    good = (1 - _SHARE) * math.exp(-0.5 * (off / _SAME_MOTION) ** 2)
    bad = _SHARE * _SAME_MOTION / _MISCALIBRATED * math.exp(-0.5 * (off / _MISCALIBRATED) ** 2)
    return -math.log(max(good + bad, 1e-300))


def _by_size(name: str, values: FloatArray, unit: str) -> float:
    """What sizes cost that cars do not have."""
    size = np.abs(values[np.isfinite(values)]) * factor(name, unit)
    if not len(size):
        return 0.0
    if name == "speed":
        top = float(np.quantile(size, 0.99))
        return min(_WORST, 0.5 * (max(top - _SPEED_MPS, 0.0) / _SPEED_SPREAD) ** 2)
    rms = float(np.sqrt(np.mean(size**2)))
    return min(_WORST, 0.5 * (math.log(max(rms, 1e-9) / _ACCEL_MPS2) / _ACCEL_SPREAD) ** 2)
