"""Which variables of an FMU are command, acceleration and speed: by given names, their own names, or causality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from avtorch.errors import InputError, listed, printable, quoted
from avtorch.io.mapping import PEDALS
from avtorch.io.units import factor, stated_unit
from avtorch.logcheck.vocabulary import header_of, likeness

SIGNALS = ("accel_cmd", "accel", "speed")
STARTS = ("speed0", "accel0")
_POWERS = {"accel": {"m": 1, "s": -2}, "speed": {"m": 1, "s": -1}}
_KIND = {"accel_cmd": "accel", "accel": "accel", "speed": "speed", "speed0": "speed", "accel0": "accel"}
_CAUSALITY = {"accel_cmd": "an input", "accel": "an output", "speed": "an output"} | dict.fromkeys(
    STARTS, "a parameter that can be set"
)
_SI = {"accel": "m/s²", "speed": "m/s"}
REALS = ("Real", "Float64", "Float32")
_NO_UNIT = ("", "-", "1")


@dataclass(frozen=True)
class Variable:
    """A scalar of an FMU, as its modelDescription.xml has it."""

    name: str
    type: str
    causality: str
    settable: bool
    unit: str | None
    powers: dict[str, int] | None
    factor: float
    offset: float
    start: float | None
    least: float | None
    most: float | None


@dataclass(frozen=True)
class Port:
    """A variable that stands for a signal; `si` of the signal is `factor` times its value."""

    variable: Variable
    factor: float
    note: str


def ports(
    source: str, variables: Sequence[Variable], names: Mapping[str, str], units: Mapping[str, str]
) -> dict[str, Port]:
    """The signals of an FMU, and the start values that it lets one set; `units` overrule what it states.

    Raises InputError for a signal that is not found or may be several variables, and for a unit of another quantity.
    """
    variables = [v for v in variables if v.type in REALS]
    found: dict[str, Port] = {}
    for signal in (*SIGNALS, *STARTS):
        able = [v for v in variables if _fits(v, signal)]
        if signal in names:
            variable, how = _named(source, signal, names[signal], variables, able), "as given"
        elif same := [v for v in able if v.name == signal]:
            variable, how = same[0], "by its name"
        elif signal in STARTS:
            own = found[signal.removesuffix("0")].variable
            if not (own.settable and own.causality == "output"):
                continue
            variable, how = own, "its start value"
        else:
            variable, how = _recognised(source, signal, able)
        if twin := next((s for s, p in found.items() if p.variable is variable and s + "0" != signal), None):
            raise InputError(f"{source}: variable {quoted(variable.name)} is both {twin} and {signal}; needs two")
        found[signal] = _port(source, signal, variable, how, units)
    return found


def _fits(v: Variable, signal: str) -> bool:
    if signal == "accel_cmd":
        return v.causality == "input"
    return v.settable and v.causality != "input" if signal in STARTS else v.causality == "output"


def _named(source: str, signal: str, name: str, variables: list[Variable], able: list[Variable]) -> Variable:
    # what is given may also be a local variable, but not the other way round
    may = [v for v in variables if v.causality != "input"] if signal in ("accel", "speed") else able
    found = next((v for v in may if v.name == name), None)
    if found is None:
        what = f"needs {_CAUSALITY[signal]}, a real variable; candidates: {_names(able)}"
        raise InputError(f"{source}: {signal} = {quoted(name)}: {what}")
    return found


def _recognised(source: str, signal: str, able: list[Variable]) -> tuple[Variable, str]:
    by_unit = [v for v in able if _stated(v, _KIND[signal]) is not None]
    unstated = [v for v in able if _without_unit(v)]
    by_name = [v for v in unstated if likeness(header_of(v.name), signal) > 0]
    if signal != "accel_cmd":
        # commands are in m/s², too: of several outputs in that unit the one that is called an acceleration
        by_name = by_name or [v for v in by_unit if likeness(header_of(v.name), signal) > 0]
    ways: list[tuple[list[Variable], str]] = [(by_unit, "by its unit"), (by_name, "by its name")]
    if signal == "accel_cmd":
        ways.insert(0, (able, "the only input"))
    for candidates, how in ways:
        if len(candidates) == 1:
            return candidates[0], how
    kind = "input" if signal == "accel_cmd" else "output"
    needs = f'map={{{signal!r}: ...}} or a line {signal} = "..." below [fmu] in its TOML file'
    if not able:
        raise InputError(f"{source}: has no real {kind} for {signal}; an FMU with one is needed")
    if signal == "accel_cmd" and (pedals := [v for v in able if any(likeness(header_of(v.name), p) for p in PEDALS)]):
        raise InputError(
            f"{source}: takes {_names(pedals)}, and no acceleration; an FMU is driven by accel_cmd: put what makes "
            "pedals of it into the FMU, or give --simulated its output"
        )
    raise InputError(f"{source}: {signal} may be several of its {kind}s, or none: {_names(able)}; needs {needs}")


def _names(variables: list[Variable]) -> str:
    return listed(v.name + (f" [{v.unit}]" if v.unit else "") for v in variables) or "none"


def _port(source: str, signal: str, v: Variable, how: str, units: Mapping[str, str]) -> Port:
    kind = _KIND[signal]
    given = units.get(signal, units.get(signal.removesuffix("0")))
    head = f"{signal}: variable {quoted(v.name)} ({how})"
    if given is not None:
        return Port(v, factor(kind, given), f"{head}, in {printable(given, 20)} as given")
    size = _stated(v, kind)
    if size is not None:
        return Port(v, size, f"{head}, in {printable(v.unit or _SI[kind], 20)}")
    if not _without_unit(v):
        raise InputError(
            f"{source}: {signal} is variable {quoted(v.name)} in {quoted(v.unit or '', 20)}; needs a variable in a "
            f'unit such as {_SI[kind]}, or a line {signal} = "{_SI[kind]}" below [fmu.unit] in its TOML file'
        )
    unit = header_of(v.name).unit
    if unit is not None and stated_unit(kind, unit) is not None:
        return Port(v, factor(kind, unit), f"{head}, in {unit} by its name")
    return Port(v, 1.0, f"{head}, which states no unit: taken as {_SI[kind]}")


def _without_unit(v: Variable) -> bool:
    return v.powers == {} if v.powers is not None else (v.unit or "").strip() in _NO_UNIT


def _stated(v: Variable, kind: str) -> float | None:
    """The factor to SI of the unit that a variable states, where that is one of an acceleration or of a speed."""
    if v.powers:
        return v.factor if v.powers == _POWERS[kind] and v.offset == 0 else None
    text = "" if _without_unit(v) else v.unit or ""
    # FMI writes m.s-2
    unit = stated_unit(kind, text) or stated_unit(kind, text.replace(".", "").replace("*", ""))
    return None if unit is None else factor(kind, unit)
