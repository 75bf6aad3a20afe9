"""Numeric fields of a ROS message type, from its definition alone, and the stamp that dates a message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_TIME = "builtin_interfaces/msg/Time"
_DURATION = "builtin_interfaces/msg/Duration"
_NUMBERS = frozenset(
    (
        "bool", "byte", "char", "octet", "float32", "float64",
        "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
    )
)  # fmt: skip
_DEEPEST = 8
_MOST = 2000  # fields of one type: types within types may multiply
_MOST_VISITED = 50_000  # fields looked at for it, also those that are no numbers
_BASE, _NAME = 1, 2  # kinds of a field: a number or text, another type; the rest are arrays

Definitions = Mapping[str, Any]


def numeric_fields(definitions: Definitions, type_: str) -> list[str]:
    """Paths such as ``twist.linear.x`` of the numeric fields, without arrays, stamps and durations; 2000 at most.

    Raises KeyError for a type that is not defined.
    """
    found: list[str] = []
    _collect(definitions, type_, (), found, [_MOST_VISITED])
    return found


def _collect(definitions: Definitions, type_: str, before: Sequence[str], found: list[str], left: list[int]) -> None:
    if len(before) >= _DEEPEST:
        return
    for name, (kind, what) in definitions[type_][1]:
        left[0] -= 1
        if left[0] < 0 or len(found) >= _MOST:
            return
        path = (*before, name)
        if kind == _BASE and what[0] in _NUMBERS:
            found.append(".".join(path))
        elif kind == _NAME and what not in (_TIME, _DURATION):
            _collect(definitions, what, path, found, left)


def stamp_field(definitions: Definitions, type_: str) -> str | None:
    """The path of the stamp that dates a message: its header's, or its own; None where it has neither."""
    fields = dict(definitions[type_][1])
    if fields.get("stamp") == (_NAME, _TIME):
        return "stamp"
    kind, what = fields.get("header", (None, None))
    if kind == _NAME and dict(definitions[what][1]).get("stamp") == (_NAME, _TIME):
        return "header.stamp"
    return None
