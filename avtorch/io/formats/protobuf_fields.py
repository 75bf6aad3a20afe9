"""Numbers of a protobuf message, from its definition alone, and the stamp that dates it."""

from __future__ import annotations

import math
from typing import Any

Path = tuple[str, ...]

_DEEPEST = 8
_MOST = 2000  # fields of one type: types within types may multiply
_MOST_VISITED = 50_000  # fields looked at for it, also those that are no numbers


def numeric_fields(descriptor: Any) -> list[Path]:
    """Paths of all numbers, states and enums included, without repeated fields; 2000 at most."""
    found: list[Path] = []
    _collect(descriptor, (), found, [_MOST_VISITED])
    return found


def _collect(descriptor: Any, before: Path, found: list[Path], left: list[int]) -> None:
    if len(before) >= _DEEPEST:
        return
    for one in descriptor.fields:
        left[0] -= 1
        if left[0] < 0 or len(found) >= _MOST:
            return
        if one.label == one.LABEL_REPEATED:
            continue
        path = (*before, one.name)
        if one.cpp_type == one.CPPTYPE_MESSAGE:
            _collect(one.message_type, path, found, left)
        elif one.cpp_type != one.CPPTYPE_STRING:
            found.append(path)


def stamp_field(descriptor: Any) -> Path | None:
    """Where Apollo's header holds the moment of a message [s]; None for a type without such a header."""
    header = descriptor.fields_by_name.get("header")
    if header is None or header.message_type is None:
        return None
    return ("header", "timestamp_sec") if "timestamp_sec" in header.message_type.fields_by_name else None


def value_at(message: Any, path: Path) -> float:
    """The number at a path, NaN where the message has not set it: a default is no measurement."""
    for name in path:
        one = message.DESCRIPTOR.fields_by_name[name]
        if one.has_presence and not message.HasField(name):
            return math.nan
        message = getattr(message, name)
    return float(message)
