"""Stamps that ROS writes in two columns, whole seconds and the nanoseconds beside them, as one column."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from typing import Any

from numpy.typing import NDArray

_NANOSECONDS = re.compile(r"(?P<stem>.*?)(?:nanosecs?|nsecs?|ns)")
_SECONDS = ("sec", "secs", "s")
_AND = " + "


def whole_stamps(names: Collection[str]) -> dict[str, tuple[str, str]]:
    """Columns of seconds and of nanoseconds by the name of their sum, `stamp.sec + stamp.nanosec`."""
    found = {}
    for name in names:
        match = _NANOSECONDS.fullmatch(name)
        for seconds in (match["stem"] + form for form in _SECONDS) if match else ():
            if seconds in names:
                found[f"{seconds}{_AND}{name}"] = seconds, name
    return found


def with_halves(wanted: Callable[[tuple[str, ...]], Collection[str]]) -> Callable[[tuple[str, ...]], Collection[str]]:
    """What is wanted of a file's columns, with both columns of a stamp that is."""

    def chosen(names: tuple[str, ...]) -> set[str]:
        named = set(wanted(names))
        return named | {half for whole, halves in whole_stamps(names).items() if whole in named for half in halves}

    return chosen


def with_whole_stamps(
    names: Sequence[str], cells: Sequence[Sequence[Any] | NDArray | None]
) -> tuple[tuple[str, ...], tuple[Sequence[Any] | NDArray | None, ...]]:
    """The `names` and `cells` of a table's columns, with a column of text for each stamp in two: the digits side by
    side, None where its columns were not read."""
    whole = list(cells)
    found = whole_stamps(names)
    for halves in found.values():
        seconds, nanoseconds = (cells[names.index(half)] for half in halves)
        if seconds is None or nanoseconds is None:
            whole.append(None)
        else:
            whole.append([_stamp(str(a).strip(), str(b).strip()) for a, b in zip(seconds, nanoseconds, strict=True)])
    return (*names, *found), tuple(whole)


def _stamp(seconds: str, nanoseconds: str) -> str:
    whole, parts = seconds.removesuffix(".0"), nanoseconds.removesuffix(".0")
    if whole.isdecimal() and parts.isdecimal() and len(parts) <= 9:
        return f"{whole}.{parts:0>9}"
    return f"{seconds}{_AND}{nanoseconds}"
