"""Other names, units and clocks, from ``--map``, ``--unit`` and the TOML file beside the log."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from avtorch.errors import InputError, printable, quoted
from avtorch.io.opening import place, read_toml
from avtorch.io.units import to_si
from avtorch.numeral import numeral

SIGNALS = (
    "time", "accel_cmd", "accel", "speed", "jerk", "engaged", "spacing", "lead_speed", "lead_accel", "grade", "segment",
    "throttle", "brake", "torque", "current", "speed_cmd",
)  # fmt: skip
PEDALS = ("throttle", "brake", "torque", "current")
"""Commands that are no accelerations; a map makes one of them (`avtorch.pedals`)."""

_TABLES = ("map", "unit", "stamp", "state")
_OTHERS = ("fmu",)  # tables of the same file that are not about the log
Pairs = Mapping[str, Any] | Iterable[str] | None


@dataclass(frozen=True)
class SignalMap:
    """Where each signal of a log is found; every dict is keyed by signal."""

    column: dict[str, str] = field(default_factory=dict)
    unit: dict[str, str] = field(default_factory=dict)
    stamp: dict[str, str] = field(default_factory=dict)
    state: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def column_of(self, signal: str) -> str:
        """The column of a signal: one of its own name unless the mapping says another."""
        return self.column.get(signal, signal)


def read_mapping(
    path: str | os.PathLike[str], *, map: Pairs = None, unit: Pairs = None, stamp: Pairs = None, state: Pairs = None
) -> SignalMap:
    """The mapping for the log at ``path``: the TOML file beside it (``lap.csv`` has ``lap.toml``), overruled by the
    arguments, each a dict or a sequence of ``SIGNAL=VALUE``.

    The TOML file has the tables ``[map]`` (signal = "column"), ``[unit]`` (signal = "km/h"), ``[stamp]`` (signal = "its
    own time column") and ``[state]`` (engaged = "1, 3": the numbers that mean yes). A table ``[fmu]`` is left to
    `avtorch.external.FmuSimulator`. It is a regular file of up to 1 MB, no link. Raises InputError for another kind of
    file, and for a signal, unit or table that is not known.
    """
    beside = mapping_beside(path)
    stated = SignalMap() if beside is None else _read_toml(beside)
    return given_mapping(stated, map=map, unit=unit, stamp=stamp, state=state)


def given_mapping(
    stated: SignalMap, *, map: Pairs = None, unit: Pairs = None, stamp: Pairs = None, state: Pairs = None
) -> SignalMap:
    """The mapping that arguments give, on top of what a file `stated`. Raises InputError as `read_mapping` does."""
    given = _checked(map=map, unit=unit, stamp=stamp, state=state)
    columns = _distinct(stated.column | given.column)
    return SignalMap(columns, stated.unit | given.unit, stated.stamp | given.stamp, stated.state | given.state)


def _checked(*, map: Pairs, unit: Pairs, stamp: Pairs, state: Pairs) -> SignalMap:
    units, stamps = pairs("unit", unit), pairs("stamp", stamp)
    for signal, one in units.items():
        to_si(signal, one)
    if "time" in stamps:
        given = f"stamp time={printable(stamps['time'], 40)}"
        raise InputError(f"{given}: time is the clock itself; only other signals are stamped")
    return SignalMap(pairs("map", map), units, stamps, _states(pairs("state", state)))


def mapping_beside(log: str | os.PathLike[str]) -> Path | None:
    """The mapping file of a log, where there is one; a log that is called x.toml itself has none."""
    log = Path(log)
    try:
        beside = mapping_place(log)
        return beside if beside != log and os.path.lexists(beside) else None
    except (OSError, ValueError):  # no file beside the log can have its name
        return None


def mapping_place(log: Path) -> Path:
    """Where the mapping file of a log belongs: `lap.toml` beside `lap.csv` and beside `lap.csv.gz`."""
    return (log.with_suffix("") if log.suffix.lower() == ".gz" else log).with_suffix(".toml")


def pairs(option: str, given: Pairs) -> dict[str, str]:
    """``{"accel": "CAN.ACC_X"}`` or ``["accel=CAN.ACC_X"]`` as a dict; InputError for a malformed or unknown one."""
    if given is None:
        return {}
    if isinstance(given, str):
        given = [given]
    if isinstance(given, Mapping):
        items = [(str(name), str(value)) for name, value in given.items()]
    else:
        items = []
        for text in given:
            name, mark, value = str(text).partition("=")
            if not mark or not name.strip() or not value.strip():
                raise InputError(
                    f"{option}: {quoted(str(text))} is not of the form SIGNAL=VALUE, such as {_EXAMPLE[option]}"
                )
            items.append((name.strip(), value.strip()))
    answer: dict[str, str] = {}
    for name, value in items:
        if name not in SIGNALS:
            here = f"{option} {printable(name, 40)}={printable(value, 40)}"
            raise InputError(f"{here}: {quoted(name)} is no signal; signals: {', '.join(SIGNALS)}")
        if answer.get(name, value) != value:
            raise InputError(f"{option} {name}: given as {quoted(answer[name])} and as {quoted(value)}; once is enough")
        answer[name] = value
    return answer


_EXAMPLE = {"map": "accel=CAN.ACC_X", "unit": "speed=km/h", "stamp": "speed=GPS_TIME", "state": "engaged=1,3"}


def _states(states: dict[str, str]) -> dict[str, tuple[float, ...]]:
    found: dict[str, tuple[float, ...]] = {}
    for signal, text in states.items():
        if signal != "engaged":
            raise InputError(f"state {signal}={printable(text, 40)}: only engaged is a state")
        try:
            found[signal] = tuple(numeral(part) for part in text.split(","))
        except ValueError:
            raise InputError(f"state {signal}={printable(text, 40)}: needs numbers such as 1,3") from None
    return found


def _distinct(columns: dict[str, str]) -> dict[str, str]:
    seen: dict[str, str] = {}
    for signal, column in columns.items():
        if column in seen:
            raise InputError(
                f"map {signal}={printable(column, 40)}: column {quoted(column)} is already mapped to {seen[column]}"
            )
        seen[column] = signal
    return columns


def _read_toml(file: Path) -> SignalMap:
    content = read_toml(file, links=False)
    here = f"{place(file)}: "
    for name, table in content.items():
        if name not in (*_TABLES, *_OTHERS):
            known = ", ".join((*_TABLES, *_OTHERS))
            raise InputError(f"{here}table [{printable(name, 40)}] is not known; tables: {known}")
        if not isinstance(table, dict):
            raise InputError(f"{here}{name} is no table; write [{name}] and its lines below")
    try:
        return _checked(**{name: _texts(content.get(name, {}), name) for name in _TABLES})
    except InputError as fault:
        raise InputError(f"{here}{fault}") from None


def _texts(table: dict[str, Any], name: str) -> dict[str, str]:
    texts = {}
    for key, value in table.items():
        if isinstance(value, bool) or not isinstance(value, (str, int, float)):
            # the commonest cause: map.accel = ... with a dot in an unquoted key
            raise InputError(f"[{name}] {printable(key, 40)}: is a {type(value).__name__}; a text is needed")
        try:
            texts[key] = str(value)
        except ValueError:  # a whole number of thousands of digits
            raise InputError(f"[{name}] {printable(key, 40)}: is too large a number; a text is needed") from None
    return texts
