"""Where the gap lies: in time, speed, command and frequency, and whether in the car's motion or in the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Axis = Literal["time", "speed", "command", "frequency", "signal"]

UNITS: dict[Axis, str] = {"time": "s", "speed": "m/s", "command": "m/s²", "frequency": "Hz", "signal": ""}


@dataclass(frozen=True)
class Location:
    """A part of the gap: `begin` to `end` on an `axis`, with its `share` of the cause's contribution.

    Times are on the log's own clock [s], the others [m/s, m/s², Hz]; on the axis `signal` both are `"actuation"` (the
    car's motion differs) or `"sensing"` (the accelerometer's reading differs). `q_value`: the false-discovery rate at
    which all parts with a q-value as small are named.
    """

    axis: Axis
    begin: float | str
    end: float | str
    share: float
    q_value: float

    def words(self, epoch_s: float = 0.0) -> str:
        """The part as a phrase; times count from `epoch_s`, the log's start on its own clock."""
        if isinstance(self.begin, str) or isinstance(self.end, str):
            return "in the car's motion" if self.begin == "actuation" else "in the accelerometer's reading"
        if self.axis == "time":
            return f"from {self.begin - epoch_s:.1f} to {self.end - epoch_s:.1f} s after the log's start"
        at, unit = "frequencies" if self.axis == "frequency" else f"{self.axis}s", UNITS[self.axis]
        ends = f"from {self.begin:.2g} to {self.end:.2g}" if self.begin else f"below {self.end:.2g}"
        return f"at {at} {ends} {unit}"

    def to_dict(self) -> dict[str, Any]:
        """An entry of `where` in `diagnosis.json`."""
        part = {"axis": self.axis, "from": self.begin, "to": self.end}
        return part | {"share": self.share, "q_value": self.q_value}
