"""The drives as the search saw them, with what the simulator makes of their commands, before and after the repair."""

from __future__ import annotations

from dataclasses import dataclass, field

from avtorch.arrays import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Traces:
    """Rows that count, averaged to some 20 Hz. Accelerations [m/s²], speed [m/s], `time` [s] from their log's start.

    `command` (row,); `measured`, `before`, `after` (channel, row): what the log shows, and rollouts over whole drives
    of the fitted simulator without and with the effect (equal where nothing was named). `does` (row,) [nats]: what the
    effect does to each row. `stretch` (row,) numbers parts without gaps.
    """

    time: FloatArray
    command: FloatArray
    channels: tuple[str, ...]
    measured: FloatArray = field(repr=False)
    before: FloatArray = field(repr=False)
    after: FloatArray = field(repr=False)
    does: FloatArray = field(repr=False)
    stretch: IntArray = field(repr=False)

    @property
    def speed(self) -> FloatArray | None:
        """Measured, (row,); None where it was not."""
        return self.measured[self.channels.index("speed")] if "speed" in self.channels else None
