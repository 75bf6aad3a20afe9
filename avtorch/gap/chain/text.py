"""A plant as text: TOML, files, and short strings such as `"dead_time=0.2, saturation.accel_max_mps2=1.5"`."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from avtorch.errors import InputError
from avtorch.gap.chain.effect import Effect, effect_class
from avtorch.vehicle.arguments import tensor

_BASELINE = ("T_L", "K_L", "sigma")


@dataclass(frozen=True)
class Described:
    """A plant in words: the values of the `baseline` that were given, and the effects."""

    baseline: dict[str, float]
    effects: list[Effect]


def described(text: str, more: Iterable[type[Effect]] = ()) -> Described:
    """From TOML or a short string; `"glvd"` or nothing is the bare GLVD. Raises `InputError` for what is wrong in it.

    In a short string an effect's name stands for its first parameter, `effect.parameter` for any, and an effect
    without a value takes its typical ones.
    """
    if "\n" in text or "[" in text:
        try:
            return _of(tomllib.loads(text), more)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"plant: no TOML ({error})") from None
    tables: dict[str, Any] = {}
    for item in filter(None, (x.strip() for x in text.split(","))):
        key, equals, value = (x.strip() for x in item.partition("="))
        if key.lower() == "glvd" and not equals:
            continue
        number = None
        if equals:
            try:
                number = float(value)
            except ValueError:
                raise InputError(f"plant: found {item!r}, needs a number after '='") from None
        if key in _BASELINE and number is not None:
            tables[key] = number
            continue
        name, _, parameter = key.partition(".")
        table = tables.setdefault(name, {})
        if number is not None:
            table[parameter or _first(effect_class(name, more))] = number
    return _of(tables, more)


def names_a_file(text: str) -> bool:
    """Whether a string is a file's name, there or missing, and not a plant in words."""
    if "\n" in text or text.strip().lower() in ("", "glvd"):
        return False
    try:
        return text.strip().lower().endswith(".toml") or Path(text).is_file()
    except (OSError, ValueError):  # too long for a name, or with a zero byte in it
        return False


def read_file(path: str | PathLike[str], more: Iterable[type[Effect]] = ()) -> Described:
    """From a TOML file. Raises `InputError` where it cannot be read."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"plant: {path}: no such file; needs a TOML file, or effects such as dead_time=0.2") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"plant: {path} cannot be read ({error})") from None
    return described(text + "\n", more)


def to_toml(effects: Iterable[Effect], baseline: Mapping[str, Any]) -> str:
    """TOML that `described` reads back to the same numbers."""
    lines = [f"{name} = {_number(name, value)}" for name, value in baseline.items()]
    for given in effects:
        effect, _ = given.lag_apart()  # T_L stands there already
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
        return "[" + ", ".join(repr(float(x)) for x in value) + "]"
    return repr(value if isinstance(value, int) else float(value))


def _of(tables: Mapping[str, Any], more: Iterable[type[Effect]]) -> Described:
    baseline: dict[str, float] = {}
    effects = []
    for name, value in tables.items():
        if name in _BASELINE:
            if not isinstance(value, int | float):
                raise InputError(f"{name}: found {value!r}, needs a number")
            baseline[name] = float(value)
        elif isinstance(value, Mapping):
            effects.append(effect_class(name, more).of({k: _value(name, k, v) for k, v in value.items()}))
        elif isinstance(value, int | float):
            cls = effect_class(name, more)
            effects.append(cls.of({_first(cls): float(value)}))
        else:
            raise InputError(f"{name}: found {value!r}, needs a table of parameters")
    return Described(baseline, effects)


def _value(effect: str, key: str, value: Any) -> Any:
    if isinstance(value, list) and all(isinstance(x, int | float) for x in value):
        return tensor(value) if key == "profile" else tuple(float(x) for x in value)
    if not isinstance(value, int | float):
        raise InputError(f"{effect}.{key}: found {value!r}, needs a number")
    return value


def _first(cls: type[Effect]) -> str:
    """The first parameter as the answer names it."""
    return next(iter(cls().report(tensor(0.3))))
