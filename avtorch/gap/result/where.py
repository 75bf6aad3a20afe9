"""Where a gap lies, as an answer says it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Axis = Literal["time", "speed", "command", "frequency", "signal"]

UNITS: dict[Axis, str] = {"time": "s", "speed": "m/s", "command": "m/s²", "frequency": "Hz", "signal": ""}


@dataclass(frozen=True)
class Location:
    """A part of the gap: `begin` to `end` on an `axis`, with its `share` of what the cause does to the log.

    Times are on the log's own clock [s], the others [m/s, m/s², Hz]; of the axis `signal` both are `"actuation"` (the
    car moves otherwise) or `"sensing"` (the accelerometer shows it otherwise).
    `q_value`: the false-discovery rate at which all parts with one as small are named.
    """

    axis: Axis
    begin: float | str
    end: float | str
    share: float
    q_value: float

    def to_dict(self) -> dict[str, Any]:
        """An entry of `where` in `diagnosis.json`."""
        part = {"axis": self.axis, "from": self.begin, "to": self.end}
        return part | {"share": self.share, "q_value": self.q_value}
