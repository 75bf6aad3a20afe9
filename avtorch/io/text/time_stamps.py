"""Times written as text, such as `2024-09-16T10:02:28.125+02:00` or `10:02:28,125`, as seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from functools import lru_cache
from zoneinfo import ZoneInfo

import numpy as np

from avtorch.arrays import FloatArray

_DAY_S = 86_400.0
_STAMP = re.compile(
    r"\s*(?:(?P<a>\d{1,4})(?P<mark>[-/.])(?P<b>\d{1,2})(?P=mark)(?P<c>\d{1,4})[T\s_]+)?"
    r"(?P<h>\d{1,2}):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,:](?P<fraction>\d{1,12}))?"
    r"\s*(?P<half>[AaPp][Mm])?\s*(?P<zone>Z|[+-]\d{2}:?\d{2}|[A-Za-z][A-Za-z_]*(?:/[A-Za-z_]+)*)?\s*"
)
_TEXT = 100  # characters of the longest


def is_time(cell: str) -> bool:
    """Whether a cell is a time of day, with or without a date."""
    return len(cell) <= _TEXT and _STAMP.fullmatch(cell) is not None


def seconds_of(cells: Sequence[str]) -> tuple[FloatArray, tuple[str, ...]]:
    """Seconds (cell,) of times as text, NaN where a cell is none, and remarks on what was assumed.

    With a date they count from 1970, in UTC where a zone is stated (`Z`, an offset, `UTC`, or a name such as
    `Europe/Berlin`); without one from midnight, and go on counting over the next.
    """
    stamps = [_STAMP.fullmatch(cell) if len(cell) <= _TEXT else None for cell in cells]
    remarks: list[str] = []
    order = _order(stamps, remarks)
    out = np.full(len(cells), np.nan)
    unknown: set[str] = set()
    for row, stamp in enumerate(stamps):
        if stamp is None:
            continue
        clock = _clock(stamp)
        day = 0.0 if stamp["a"] is None else _day(stamp["a"], stamp["b"], stamp["c"], order)
        if clock is None or day is None:
            continue
        ahead = _ahead(stamp["zone"], day + clock)
        if ahead is None:
            unknown.add(stamp["zone"])
        out[row] = day + clock - (ahead or 0.0)
    if unknown:
        remarks.append(f"time zone {', '.join(sorted(unknown)[:3])} is not known and was not applied")
    if all(stamp is None or stamp["a"] is None for stamp in stamps):
        _over_midnight(out)
    return out, tuple(remarks)


def _clock(stamp: re.Match[str]) -> float | None:
    hours, minutes, seconds = int(stamp["h"]), int(stamp["m"]), int(stamp["s"])
    if stamp["half"]:
        if not 1 <= hours <= 12:
            return None
        hours = hours % 12 + (12 if stamp["half"].lower() == "pm" else 0)
    if hours > 24 or minutes > 59 or seconds > 60:
        return None
    fraction = float(f"0.{stamp['fraction']}") if stamp["fraction"] else 0.0
    return 3600.0 * hours + 60.0 * minutes + seconds + fraction


def _order(stamps: Sequence[re.Match[str] | None], remarks: list[str]) -> str:
    """`ymd`, `dmy` or `mdy`; a point between the numbers is written day first."""
    dated = [stamp for stamp in stamps if stamp is not None and stamp["a"] is not None]
    if not dated or len(dated[0]["a"]) == 4:
        return "ymd"
    if any(int(stamp["a"]) > 12 for stamp in dated) or dated[0]["mark"] == ".":
        return "dmy"
    if any(int(stamp["b"]) > 12 for stamp in dated) or dated[0]["half"]:
        return "mdy"
    remarks.append(f"the date {dated[0]['a']}/{dated[0]['b']}/{dated[0]['c']} is read month first")
    return "mdy"


@lru_cache(maxsize=64)
def _day(a: str, b: str, c: str, order: str) -> float | None:
    """Seconds from 1970 to the beginning of a day."""
    numbers = dict(zip(order, (int(a), int(b), int(c)), strict=True))
    try:
        return datetime(numbers["y"], numbers["m"], numbers["d"], tzinfo=UTC).timestamp()
    except ValueError:
        return None


def _ahead(zone: str | None, stamp: float) -> float | None:
    """Seconds that a zone's clock is ahead of UTC; None for an unknown one."""
    if zone is None or zone.upper() in ("Z", "UTC", "GMT"):
        return 0.0
    if zone[0] in "+-":
        size = 3600.0 * int(zone[1:3]) + 60.0 * int(zone[-2:])
        return size if zone[0] == "+" else -size
    return _ahead_there(zone, int(stamp // 900))


@lru_cache(maxsize=256)
def _ahead_there(zone: str, quarter: int) -> float | None:
    try:
        there = ZoneInfo(zone)
    except (ValueError, OSError, LookupError):
        return None
    local = datetime.fromtimestamp(900.0 * quarter, UTC).replace(tzinfo=there)
    ahead = local.utcoffset()
    return None if ahead is None else ahead.total_seconds()


def _over_midnight(seconds: FloatArray) -> None:
    """Counts on where a clock of hours begins anew."""
    known = np.flatnonzero(np.isfinite(seconds))
    backwards = np.diff(seconds[known]) < -_DAY_S / 2
    seconds[known[1:]] += _DAY_S * np.cumsum(backwards)
