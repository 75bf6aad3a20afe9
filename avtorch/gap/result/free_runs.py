"""Free runs on blocks of the drives: no measurement corrects the simulated speed for `HORIZON_S`.

Commands, and the speed that effects read, are the log's. Blocks are groups of neighbouring hops of the lapped
transform's frames, dealt into folds; with several drives of similar length whole drives are held out. Frames that reach
into a held-out block teach nothing. Pictures, and sizes of the gap, are made of counted rows, averaged to about 20 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.drive_record import HORIZON_S, RATE_HZ, MeasuredRows, free_runs, grouped, runs_over
from avtorch.gap.engine.drive_data import DriveData, Grid
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.io import Log
from avtorch.io.engagement import SETTLE_S

FOLDS = 5
FEWEST = 5
"""Blocks without which nothing is held out."""
_LEAST_TAUGHT = 3  # frames: one more than channels, or a band's covariance is not known
_BLOCKS = 20  # of a long drive
_DRIVES = 3  # fewest drives of which whole ones are held out, none of them longer than half of all


@dataclass(frozen=True, eq=False)
class Blocks:
    """Blocks of rows, in order, and the `fold` (block,) that holds each out. Of frames: the block (frame,) of their
    first hop, and the folds' masks `taught` (fold, frame). `by_drives`: folds are whole drives.

    """

    rows: tuple[slice, ...]
    fold: IntArray
    block_of_frame: IntArray = field(repr=False)
    taught: BoolArray = field(repr=False)
    by_drives: bool = False

    @classmethod
    def of(cls, data: DriveData) -> Blocks | None:
        """The blocks of the drives; None where there are fewer than `FEWEST`, or frames too few to teach."""
        M = data.frame_rows
        hops = sum(count + 1 for _, count in data.frames)
        most = max(hops // FEWEST, 1)  # hops of a block
        size = min(max(2, math.ceil(HORIZON_S / data.hop_s), round(hops / _BLOCKS)), most)  # of 1, two frames are lost
        rows: list[slice] = []
        touched: list[tuple[int, int]] = []  # first and last block of each frame
        for first, count in data.frames:
            parts = max(1, round((count + 1) / size))
            edges = np.round(np.linspace(0, count + 1, parts + 1)).astype(int)
            block = len(rows) + np.repeat(np.arange(parts), np.diff(edges))
            touched += pairwise(block.tolist())
            rows += [slice(first + int(a) * M, first + int(b) * M) for a, b in pairwise(edges)]
        if len(rows) < FEWEST:
            return None
        fold, by_drives = _folds(data, rows)
        frames = np.array(touched)[data.used]
        taught = np.array([(fold[frames] != k).all(1) for k in range(fold.max() + 1)])
        if taught.sum(1).min() < _LEAST_TAUGHT:
            return None
        return cls(tuple(rows), fold, frames[:, 0], taught, by_drives)

    @property
    def sizes(self) -> FloatArray:
        """Rows (block,)."""
        return np.array([rows.stop - rows.start for rows in self.rows], float)

    def sums(self, x: FloatArray) -> FloatArray:
        """Sums (..., block) over each block's rows of `x` (..., row)."""
        return np.stack([x[..., rows].sum(-1) for rows in self.rows], -1)

    def stitched(self, of_folds: Sequence[FloatArray] | FloatArray) -> FloatArray:
        """(channel, row): each block's by the fit that was made without it; 0 outside."""
        out = np.zeros_like(of_folds[0])
        for rows, k in zip(self.rows, self.fold, strict=True):
            out[:, rows] = of_folds[k][:, rows]
        return out

    def free_runs(self, data: DriveData, errors: FloatArray) -> FloatArray:
        """Errors (..., channel, row) of readings as those of free runs, begun anew every `HORIZON_S` in each block."""
        out = errors.copy()
        if data.speed is not None:
            out[..., -1, :] = free_runs(errors[..., -1, :], runs_over(self.rows, round(HORIZON_S / data.dt)), data.dt)
        return out


def readings(h: Hypothesis, accel: FloatArray, gained: FloatArray) -> FloatArray:
    """Grid signals as the recorder shows them: (channel, row) of acceleration [m/s²] and speed gained [m/s]."""
    return np.stack([x for x in h.recorder_rows(accel, gained) if x is not None])


def speed_gained(grid: Grid, accel: FloatArray) -> FloatArray:
    """Speed [m/s] that an acceleration (grid,) [m/s²] beyond the plant's adds."""
    step = np.where(grid.starts, 0.0, np.diff(grid.time, prepend=grid.time[:1]))
    return np.cumsum(step * np.concatenate([accel[:1], accel[:-1]]))


def measured_readings(data: DriveData) -> FloatArray:
    """(channel, row)."""
    return np.stack([x for x in (data.accel, data.speed) if x is not None])


def compared(data: DriveData, rows: FloatArray) -> list[FloatArray]:
    """Readings (channel, row) as the channels that the likelihood compares: acceleration and differenced speed."""
    return data.channel_rows(None if data.accel is None else rows[0], None if data.speed is None else rows[-1])


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


def _folds(data: DriveData, rows: Sequence[slice]) -> tuple[IntArray, bool]:
    """The fold (block,) of each block: whole logs, about equal shares of the rows, or every so-many-th block."""
    log = data.log[[b.start for b in rows]]
    sizes = np.bincount(log, [b.stop - b.start for b in rows])
    drives = [int(k) for k in np.argsort(-sizes, kind="stable") if sizes[k] > 0]
    if len(drives) < _DRIVES or sizes.max() > 0.5 * sizes.sum():
        return np.arange(len(rows)) % min(FOLDS, len(rows)), False
    held, fold = np.zeros(min(FOLDS, len(drives))), np.zeros(len(sizes), np.int64)
    for k in drives:
        fold[k] = held.argmin()
        held[fold[k]] += sizes[k]
    return fold[log], True
