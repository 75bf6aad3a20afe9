"""The columns that the known forms of recordings use; the others are not read."""

from __future__ import annotations

import re
from collections.abc import Iterable

_PLAIN = frozenset(
    (
        "Time", "Velocity", "Acceleration", "SpaceGap", "RelativeVelocity",  # I-24
        "event", "time", "speed", "accel", "spacing", "lead_speed",  # NGSIM, and plain ones
    )
)  # fmt: skip
_NUMBERED = re.compile(r"(SpeedDoppler|Accel|Spacing|Speed|IVS)[0-9]{1,6}")  # OpenACC, by vehicle


def recorded(names: Iterable[str]) -> set[str]:
    """Those of a file's columns that a known form has."""
    return {name for name in names if name in _PLAIN or _NUMBERED.fullmatch(name)}
