"""The rows that count, averaged to about 20 Hz: what pictures and sizes of the gap are made of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.io import Log
from avtorch.io.engagement import SETTLE_S

RATE_HZ = 20.0
"""Rows are averaged as long as the resulting rate is at least this [Hz]."""


@dataclass(frozen=True, eq=False)
class CountedRows:
    """Rows of a diagnosis's drives that count, `group` of them averaged into one.

    `time` (row,) [s] from the start of its log, `stamp` (row,) [s] on that log's own clock, `log` (row,) its number;
    `command` (row,) [m/s²]; `accel` [m/s²], `speed` [m/s] (row, group) as measured, None where not in the log. All rows
    are counted ones; `stretch` (row,) numbers those without gaps. `dt` [s] of an averaged row.
    """

    data: DriveData = field(repr=False)
    time: FloatArray = field(repr=False)
    stamp: FloatArray = field(repr=False)
    log: IntArray = field(repr=False)
    command: FloatArray = field(repr=False)
    accel: FloatArray | None = field(repr=False)
    speed: FloatArray | None = field(repr=False)
    stretch: IntArray = field(repr=False)
    dt: float
    group: int
    _rows: IntArray = field(repr=False)

    @classmethod
    def of(cls, data: DriveData, logs: tuple[Log, ...]) -> CountedRows:
        """The rows of `data`, from `SETTLE_S` after the begin of each stretch on."""
        group = max(1, int(1.02 / data.dt / RATE_HZ))
        rows, stretch = [], []
        for number, (i, j) in enumerate(zip(data.bounds[:-1].tolist(), data.bounds[1:].tolist(), strict=True)):
            first = i + round(SETTLE_S / data.dt)
            count = (j - first) // group
            rows.append(first + np.arange(count * group).reshape(count, group))
            stretch.append(np.full(count, number))
        at = np.concatenate(rows)
        log = data.log[at[:, 0]]
        epochs = np.array([each.epoch_s for each in logs])

        def measured(x: FloatArray | None) -> FloatArray | None:
            return None if x is None else x[at]

        return cls(
            data=data,
            time=data.stamp[at].mean(1) - epochs[log],
            stamp=data.stamp[at].mean(1),
            log=log,
            command=data.command[at].mean(1),
            accel=measured(data.accel if data.raw_accel is None else data.raw_accel),
            speed=measured(data.speed),
            stretch=np.concatenate(stretch),
            dt=group * data.dt,
            group=group,
            _rows=at,
        )

    @property
    def rows(self) -> int:
        return len(self.time)

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(name for name in ("accel", "speed") if getattr(self, name) is not None)

    @property
    def source(self) -> IntArray:
        """Places of the counted rows among the rows: all of them."""
        return np.arange(self.rows)

    @property
    def starts(self) -> IntArray:
        """First row of each stretch (stretch,)."""
        return np.flatnonzero(np.diff(self.stretch, prepend=-1))

    @property
    def measured(self) -> FloatArray:
        """Measurements (channel, row, group)."""
        return np.stack([x for x in (self.accel, self.speed) if x is not None])

    def of_rows(self, x: FloatArray) -> FloatArray:
        """Values (row of the data,) of each counted row, (row, group)."""
        return x[self._rows]

    def simulated(self, h: Hypothesis, adds: FloatArray | None = None) -> FloatArray:
        """What a hypothesis's car, behind its recorder, shows: (channel, row, group), a speed from the measured one at
        the begin of its stretch on. `adds` (grid,): acceleration beyond the hypothesis's [m/s²]."""
        data = self.data
        accel, gained = h.on_grid()
        if adds is not None:
            grid = h.data.grid
            step = np.where(grid.starts, 0.0, np.diff(grid.time, prepend=grid.time[:1]))
            more = np.cumsum(step * np.concatenate([adds[:1], adds[:-1]]))
            accel, gained = accel + adds, gained + more
        accel, gained = h.recorder_rows(accel, gained)
        out = []
        if accel is not None:
            out.append(accel[self._rows])
        if gained is not None and data.speed is not None:
            begun = np.zeros(len(data.time))
            for i, j in zip(data.bounds[:-1], data.bounds[1:], strict=True):
                some = max(3, int(0.5 / data.dt))
                begun[i:j] = float((data.speed[i : i + some] - gained[i : i + some]).mean())
            out.append((gained + begun)[self._rows])
        return np.stack(out)

    def errors(self, h: Hypothesis, adds: FloatArray | None = None) -> FloatArray:
        """Measured less simulated (channel, row, group)."""
        return self.measured - self.simulated(h, adds)
