"""What every live source gives: rows of cars, in batches of bounded size, when it is asked for them.

A source is pulled. What it has not been asked for stays in the pipe, the file or the broker's queue, so that memory
does not grow where the estimate is behind.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol


class Row(NamedTuple):
    """One row of one car: its `time` [s] on the car's own clock, and `signals` in SI units, as numbers or as a source
    found them. `position` in the source, None where it has none; it only ever grows.

    Example:
        >>> from avtorch.live import Row
        >>> Row("red", 12.34, {"accel_cmd": 0.5, "accel": 0.4, "speed": 21.0}).car
        'red'
    """

    car: str
    time: float
    signals: Mapping[str, Any]
    position: int | None = None


@dataclass(frozen=True)
class Batch:
    """Rows read at once, maybe none; `position` in the source behind them; `arrived` when (`time.monotonic`).

    `anew`: positions count from 0 again from this batch on, as where a file was replaced.

    Example:
        >>> from avtorch.live import Batch, Row
        >>> len(Batch([Row("red", 0.0, {"accel_cmd": 0.5, "speed": 21.0})]).rows)
        1
    """

    rows: list[Row]
    position: int | None = None
    anew: bool = False
    arrived: float = field(default_factory=time.monotonic)


class Stop:
    """Set to make a source end after the batch it is at; a source looks at it at least every fifth of a second.

    Example:
        >>> from avtorch.live import Stop
        >>> stop = Stop()
        >>> stop.set()
        >>> stop.is_set
        True
    """

    def __init__(self) -> None:
        self.is_set = False

    def set(self) -> None:
        """Ask the source to end."""
        self.is_set = True


class Source(Protocol):
    """Where rows come from.

    Example:
        >>> from avtorch.live import Batch, Row
        >>> class Three:
        ...     name, identity = "three rows", None
        ...     def batches(self, stop, start=None):
        ...         yield Batch([Row("red", 0.01 * i, {"accel_cmd": 0.5, "speed": 21.0}) for i in range(3)])
        >>> sum(len(batch.rows) for batch in Three().batches(None))
        3
    """

    @property
    def name(self) -> str:
        """For messages."""
        ...

    @property
    def identity(self) -> str | None:
        """What a position belongs to; None where the source cannot be read again."""
        ...

    def batches(self, stop: Stop, start: int | None = None) -> Generator[Batch, None, None]:
        """Batches until the source ends or `stop` is set; empty ones while nothing comes. `start`: a position to read
        on from."""
        ...
