"""A plant as text: TOML, files, and short strings such as `"dead_time=0.2, saturation.accel_max_mps2=1.5"`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from avtorch.errors import InputError, quoted
from avtorch.gap.simulator.domain import Domain
from avtorch.gap.simulator.effect import Effect, effect_class
from avtorch.gap.simulator.force_table import FREE_FORMS
from avtorch.io.opening import parse_toml, place, read_toml
from avtorch.numeral import numeral
from avtorch.vehicle.arguments import tensor

_BASELINE = (
    Domain("T_L", 1e-4, 1e3, "s", kind="positive"),
    Domain("K_L", 1e-4, 1e3, neutral=0.0, kind="positive"),
    Domain("sigma", 0.0, 1e3, "m/s³"),
)
_DOMAINS = {domain.name: domain for domain in _BASELINE}
"""Valid values of the baseline's parameters."""

_LONGEST = 10_000  # most characters of a plant as a short string


@dataclass(frozen=True)
class PlantDescription:
    """A plant read from text: the given values of the `baseline`, and the effects."""

    baseline: dict[str, float]
    effects: list[Effect]


def parse_plant(text: str, more: Iterable[type[Effect]] = ()) -> PlantDescription:
    """A plant from TOML or a short string; `"glvd"` or nothing is bare GLVD. Raises `InputError` for errors in the
    text.

    In a short string an effect's name sets its first parameter, `effect.parameter` any, and an effect without a value
    has its typical ones.
    """
    if "\n" in text or "[" in text:
        return _of(parse_toml(text, "plant"), more)
    if len(text) > _LONGEST:
        raise InputError(f"plant: found {len(text):,} characters, needs {_LONGEST:,} at most, or a TOML file")
    tables: dict[str, Any] = {}
    for item in filter(None, (x.strip() for x in text.split(","))):
        key, equals, value = (x.strip() for x in item.partition("="))
        if key.lower() == "glvd" and not equals:
            continue
        name, dot, parameter = key.partition(".")
        if not equals:
            known = effect_class(name, more).name if not dot else name
            if known in tables or dot:
                raise InputError(f"plant: found {quoted(item)}, needs an effect's name, once, or NAME=NUMBER")
            tables[known] = {}
            continue
        try:
            number = numeral(value)
        except ValueError:
            raise InputError(f"plant: found {quoted(item)}, needs a number after '='") from None
        if key in _DOMAINS:
            table, parameter = tables, key
        else:
            first = _first(effect_class(name, more))
            table, parameter = tables.setdefault(name, {}), parameter if dot else first
        if parameter in table:
            raise InputError(f"plant: found {quoted(item)} besides another value, needs one")
        table[parameter] = number
    return _of(tables, more)


def names_a_file(text: str) -> bool:
    """Whether a string is a file's name, existing or missing, and not a plant as text."""
    if "\n" in text or text.strip().lower() in ("", "glvd"):
        return False
    try:
        return text.strip().lower().endswith(".toml") or Path(text).is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte in it
        return False


def read_file(path: str | PathLike[str], more: Iterable[type[Effect]] = ()) -> PlantDescription:
    """A plant from a TOML file of up to 1 MB. Raises `InputError` where it cannot be read."""
    if not os.path.lexists(path):
        raise InputError(f"plant: {place(path)}: no such file; needs a TOML file, or effects such as dead_time=0.2")
    try:
        return _of(read_toml(path), more)
    except InputError as fault:
        raise InputError(f"plant: {fault}") from None


def to_toml(effects: Iterable[Effect], baseline: Mapping[str, Any]) -> str:
    """TOML from which `parse_plant` reads the same numbers."""
    lines = [f"{name} = {_number(name, value)}" for name, value in baseline.items()]
    for given in effects:
        effect, _ = given.lag_apart()  # T_L is already written there
        lines += ["", f"[{effect.name}]"]
        for f in fields(effect):
            value = getattr(effect, f.name)
            if value is not None:
                lines.append(f"{f.name} = {_number(f'{effect.name}.{f.name}', value)}")
    return "\n".join(lines) + "\n"


def _number(name: str, value: Any) -> str:
    if isinstance(value, Tensor):
        if value.dim() > 1:
            raise InputError(f"{name}: found shape {tuple(value.shape)}, needs a single value for a text")
        value = value.tolist()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_number(name, x) for x in value) + "]"
    if isinstance(value, int) and not isinstance(value, bool):
        return repr(value)
    value = float(value)
    if math.isnan(value):
        raise InputError(f"{name}: found nan, needs a number for a text")
    return repr(value)


def _of(tables: Mapping[str, Any], more: Iterable[type[Effect]]) -> PlantDescription:
    baseline: dict[str, float] = {}
    effects = []
    more = (*FREE_FORMS, *more)
    for name, value in tables.items():
        if name in _DOMAINS:
            baseline[name] = _DOMAINS[name].value(name, value)
            continue
        cls = effect_class(name, more)
        table = value if isinstance(value, Mapping) else {_first(cls): value}
        domains = cls.domains()
        # an unknown name is passed on: the effect rejects it and lists the known ones
        given = {key: domains[key].value(f"{name}.{key}", x) if key in domains else x for key, x in table.items()}
        if "profile" in given:
            given["profile"] = tensor(given["profile"])
        effects.append(cls.of(given))
    return PlantDescription(baseline, effects)


def _first(cls: type[Effect]) -> str:
    """The first parameter under the answer's name."""
    return next(iter(cls().report(tensor(0.3))))
