"""The rows that count, averaged to about 20 Hz: what pictures and sizes of the gap are made of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.drive_record import RATE_HZ, MeasuredRows, grouped
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.result.free_runs import readings, speed_gained
from avtorch.io import Log
from avtorch.io.engagement import SETTLE_S


@dataclass(frozen=True, eq=False)
class CountedRows(MeasuredRows):
    """Rows of the engine's `data` that count, all of them, `group` averaged into one."""

    data: DriveData = field(repr=False)
    _rows: IntArray = field(repr=False)

    @classmethod
    def of(cls, data: DriveData, logs: tuple[Log, ...]) -> CountedRows:
        """The rows of `data`, from `SETTLE_S` after the begin of each stretch on."""
        group = grouped(1 / data.dt, RATE_HZ)
        rows, stretch = [], []
        for number, (i, j) in enumerate(zip(data.bounds[:-1].tolist(), data.bounds[1:].tolist(), strict=True)):
            first = i + round(SETTLE_S / data.dt)
            count = (j - first) // group
            rows.append(first + np.arange(count * group).reshape(count, group))
            stretch.append(np.full(count, number))
        at = np.concatenate(rows)
        log = data.log[at[:, 0]]
        epochs = np.array([each.epoch_s for each in logs])

        shown = (data.accel if data.raw_accel is None else data.raw_accel, data.speed)
        return cls(
            data=data,
            time=data.stamp[at].mean(1) - epochs[log],
            log=log,
            command=data.command[at].mean(1),
            channels=data.channels,
            measured=np.stack([x[at] for x in shown if x is not None]),
            stretch=np.concatenate(stretch),
            dt=group * data.dt,
            group=group,
            _rows=at,
        )

    def of_rows(self, x: FloatArray) -> FloatArray:
        """Values (row of the data,) of each counted row, (row, group)."""
        return x[self._rows]

    def simulated(self, h: Hypothesis, adds: FloatArray | None = None) -> FloatArray:
        """What a hypothesis's car, behind its recorder, shows: (channel, row, group), a speed from the measured one at
        the begin of its stretch on. `adds` (grid,): acceleration beyond the hypothesis's [m/s²]."""
        data = self.data
        accel, gained = h.on_grid()
        if adds is not None:
            accel, gained = accel + adds, gained + speed_gained(h.data.grid, adds)
        out = readings(h, accel, gained)
        if data.speed is not None:
            off, some = data.speed - out[-1], max(3, int(0.5 / data.dt))
            for i, j in zip(data.bounds[:-1], data.bounds[1:], strict=True):
                out[-1, i:j] += off[i : i + some].mean()
        return out[:, self._rows]

    def errors(self, h: Hypothesis, adds: FloatArray | None = None) -> FloatArray:
        """Measured less simulated (channel, row, group)."""
        return self.measured - self.simulated(h, adds)
