"""A recorded drive played back: a ROS 2 bag, an MCAP file, or any other recording that `Log.read` reads."""

from __future__ import annotations

import os
import time
from collections.abc import Generator
from pathlib import Path
from threading import Event

import numpy as np

from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.log import no_command
from avtorch.io.mapping import Pairs
from avtorch.io.sealed import fingerprint
from avtorch.live.source import SIGNALS, Batch, Row

ROWS = 500
"""Rows of a batch where nothing is waited for."""
TICK_S = 0.01
"""How often rows are looked for where they come at their own pace [s]."""


class PlayedLog:
    """The rows of a recording as a live source, of one car called `car`, by default as the file.

    `rate`: how many times faster than recorded; None is as fast as they are taken. Raises `InputError` as `Log.read`,
    for a log without a command, and for a rate that is not positive.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        map: Pairs = None,
        unit: Pairs = None,
        rate: float | None = None,
        car: str | None = None,
    ) -> None:
        if rate is not None and not (np.isfinite(rate) and rate > 0):
            raise InputError(f"rate: found {rate:g}, needs a finite number above 0")
        log = Log.read(path, map=map, unit=unit)
        if log.accel_cmd is None:
            raise no_command(log, "; T_L and K_L need the demanded acceleration")
        self.name, self.rate = str(path), rate
        self.car = Path(path).stem if car is None else car
        signals = [(name, getattr(log, name)) for name in SIGNALS]
        self._signals = {name: values for name, values in signals if values is not None}
        if bool(log.engaged.all()):
            self._signals.pop("engaged")
        # a segment's clock may start anew, as a car's may
        self._time = np.asarray(log.time, np.float64)
        self._elapsed = np.asarray(log.elapsed, np.float64)
        self.identity = f"{Path(path).absolute()} {fingerprint([self._time, self._signals])}"

    def batches(self, stop: Event, start: int | None = None) -> Generator[Batch, None, None]:
        """As the contract; `start` in rows."""
        row, rows = start or 0, len(self._time)
        begun, first = time.monotonic(), float(self._elapsed[min(row, rows - 1)])
        while row < rows and not stop.is_set():
            end = min(row + ROWS, rows)
            if self.rate is not None:
                now = first + (time.monotonic() - begun) * self.rate
                end = min(end, max(row, int(np.searchsorted(self._elapsed, now, side="right"))))
            yield Batch(self._rows(row, end), end)
            if end == row:
                time.sleep(TICK_S)
            row = end

    def _rows(self, first: int, end: int) -> list[Row]:
        part = {name: values[first:end].tolist() for name, values in self._signals.items()}
        times = self._time[first:end].tolist()
        return [Row(self.car, t, {name: values[i] for name, values in part.items()}) for i, t in enumerate(times)]
