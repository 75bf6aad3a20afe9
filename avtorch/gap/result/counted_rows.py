"""The rows of drives that count, what simulators make of them, and errors in free runs over them.

Rows are those of the engine's stretches, from `SETTLE_S` after the begin of each on, averaged to about 20 Hz. While a
driver is in charge (`engaged` 0) the car does not follow the command, and at standstill it does not move, so no rollout
passes through such rows.

A simulated speed is compared in free runs, each begun at what was measured: over a whole drive the speed of any model
drifts away. An acceleration needs no beginning, as the lag forgets it.

Commands, and the speed that effects read, are the log's. Blocks are groups of neighbouring hops of the lapped
transform's frames, dealt into folds; with several drives of similar length whole drives are held out. Frames that reach
into a held-out block teach nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.drive_data import DriveData, Grid
from avtorch.gap.engine.hypothesis import Hypothesis, drives_of
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from avtorch.io.engagement import SETTLE_S

HORIZON_S = 10.0
"""Of the free runs by whose errors simulators are judged [s]."""
BEGIN_S = 0.5
"""Over which the measured speed at the begin of a free run is averaged [s]."""
RATE_HZ = 20.0
"""Rows are averaged as long as the resulting rate is at least this [Hz]."""
FOLDS = 5
FEWEST = 5
"""Blocks without which nothing is held out."""
_LEAST_TAUGHT = 3  # frames: one more than channels, or a band's covariance is not known
_BLOCKS = 20  # of a long drive
_DRIVES = 3  # fewest drives of which whole ones are held out, none of them longer than half of all


@dataclass(frozen=True, eq=False)
class CountedRows:
    """Rows of the engine's `data` that count, each the mean of `group` of them.

    `time` (counted,) [s] from the start of log number `log` (counted,); `command` (counted,) [m/s²]; `measured`
    (channel, counted, group): the `channels` as they were read, `accel` [m/s²] before `speed` [m/s]. `stretch`
    (counted,) numbers the stretches without gaps. `dt` [s] of an averaged row.
    """

    data: DriveData = field(repr=False)
    time: FloatArray
    log: IntArray
    command: FloatArray
    channels: tuple[str, ...]
    measured: FloatArray
    stretch: IntArray
    dt: float
    group: int
    _rows: IntArray = field(repr=False)

    @classmethod
    def of(cls, logs: Log | Sequence[Log], data: DriveData | None = None) -> CountedRows:
        """The rows of one or several logs of one car; `data`: as the engine has read them, if it has. Raises
        `InputError` as `DriveData.of`."""
        each = [logs] if isinstance(logs, Log) else list(logs)
        data = DriveData.of(each) if data is None else data
        group = grouped(1 / data.dt, RATE_HZ)
        rows, stretch = [], []
        for number, (i, j) in enumerate(pairwise(data.bounds.tolist())):
            first = i + round(SETTLE_S / data.dt)
            count = (j - first) // group
            rows.append(first + np.arange(count * group).reshape(count, group))
            stretch.append(np.full(count, number))
        at = np.concatenate(rows)
        log = data.log[at[:, 0]]
        epochs = np.array([one.epoch_s for one in each])
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

    @property
    def rows(self) -> int:
        """Number of counted rows."""
        return len(self.time)

    @property
    def stretches(self) -> list[slice]:
        """Counted rows of each stretch."""
        starts = np.flatnonzero(np.diff(self.stretch, prepend=-1)).tolist()
        return [slice(a, b) for a, b in pairwise([*starts, self.rows])]

    @property
    def longest_s(self) -> float:
        """Length of the longest free runs [s]: `HORIZON_S`, or that of the longest stretch."""
        return min(HORIZON_S, max(part.stop - part.start for part in self.stretches) * self.dt)

    def of_rows(self, x: FloatArray) -> FloatArray:
        """Values (..., row of the data) of each counted row, (..., counted, group)."""
        return x[..., self._rows]

    @property
    def drives(self) -> list[SimulatorInput]:
        """The stretches as a simulator's inputs, in steps of the engine's grid."""
        return list(drives_of(Hypothesis(self.data)))

    # what a simulator makes of them ----------------------------------------------------------------------------------
    def errors(self, h: Hypothesis, adds: FloatArray | None = None) -> FloatArray:
        """Measured less what a hypothesis's car, behind its recorder, shows: (channel, counted, group), a speed from
        the measured one at the begin of its stretch on. `adds` (grid,): acceleration beyond the hypothesis's [m/s²]."""
        accel, gained = h.on_grid()
        if adds is not None:
            accel, gained = accel + adds, gained + speed_gained(h.data.grid, adds)
        return self.measured - self._from_measured(readings(h, accel, gained))

    def rolled_out(self, simulator: GapPlant) -> FloatArray:
        """What a simulator's car, without a recorder, shows: (channel, counted, group), its speed as above."""
        responses = [simulator.response(drive) for drive in self.drives]
        channels = {"accel": [r.accel_measured for r in responses], "speed": [r.speed_measured for r in responses]}
        rows = np.searchsorted(self.data.grid.row, np.arange(len(self.data.time)))
        return self._from_measured(np.stack([torch.cat(channels[name]).numpy()[rows] for name in self.channels]))

    def of_logs(self, logs: Sequence[Log]) -> FloatArray:
        """Readings (channel, counted, group) of other logs that have the same rows."""
        data, out = self.data, np.empty((len(self.channels), len(self.data.time)))
        for number, log in enumerate(logs):
            own = data.log == number
            rows = data.source[own][:, None] + np.arange(data.group)
            for x, name in zip(out, self.channels, strict=True):
                x[own] = getattr(log, name)[rows].mean(1)
        return self.of_rows(out)

    def _from_measured(self, shown: FloatArray) -> FloatArray:
        """Counted rows of readings (channel, row), a speed from the measured one on."""
        data = self.data
        if data.speed is not None:
            off, some = data.speed - shown[-1], max(3, int(0.5 / data.dt))
            for i, j in pairwise(data.bounds):
                shown[-1, i:j] += off[i : i + some].mean()
        return self.of_rows(shown)

    # errors ----------------------------------------------------------------------------------------------------------
    def squares(self, errors: FloatArray, parts: Sequence[slice], horizon: float = HORIZON_S) -> dict[str, FloatArray]:
        """Sums of squared errors (part,), by metric, of a rollout's `errors` (channel, counted, group) in free runs of
        at most `horizon` [s] over each of `parts` of counted rows."""
        group, out = self.group, {}
        own = [slice(part.start * group, part.stop * group) for part in parts]
        for name, x in zip(self.channels, errors.reshape(len(self.channels), -1), strict=True):
            runs = runs_over(own, round(horizon / self.dt) * group)
            away = free_runs(x, runs, self.dt / group) if name == "speed" else x
            out[f"rollout_rmse_{name}"] = np.array([away[part] @ away[part] for part in own])
        return out

    def rms(self, errors: FloatArray) -> dict[str, float]:
        """Root mean squares by channel of a rollout's `errors` (channel, counted, group) in free runs over all rows."""
        squares = self.squares(errors, self.stretches).values()
        rows = self.rows * self.group
        return {name: float(np.sqrt(x.sum() / rows)) for name, x in zip(self.channels, squares, strict=True)}


def grouped(rate: float, least: float) -> int:
    """Number of rows to average into one, at `rate` [Hz], so that about `least` [Hz] are left.

    Clocks deviate slightly, so the bound lies 2 % below the usual rates of recorders, not on one of them.
    """
    return max(1, int(1.02 * rate / least))


def runs_over(parts: Iterable[slice], rows: int) -> list[slice]:
    """Each part cut into runs of `rows` rows, the last one of what is left."""
    return [slice(i, min(i + rows, part.stop)) for part in parts for i in range(part.start, part.stop, rows)]


def free_runs(errors: FloatArray, runs: Iterable[slice], dt: float) -> FloatArray:
    """Errors (..., row) of a speed, rows `dt` [s] apart, in runs that begin at the mean measured over `BEGIN_S`."""
    out, begin = errors.copy(), max(1, round(BEGIN_S / dt))
    for run in runs:
        out[..., run] -= errors[..., run][..., :begin].mean(-1, keepdims=True)
    return out


def readings(h: Hypothesis, accel: FloatArray, gained: FloatArray) -> FloatArray:
    """Grid signals as the recorder shows them: (channel, row) of acceleration [m/s²] and speed gained [m/s]."""
    return np.stack([x for x in h.recorder_rows(accel, gained) if x is not None])


def speed_gained(grid: Grid, accel: FloatArray) -> FloatArray:
    """Speed [m/s] that an acceleration (grid,) [m/s²] beyond the plant's adds."""
    step = np.where(grid.starts, 0.0, np.diff(grid.time, prepend=grid.time[:1]))
    return np.cumsum(step * np.concatenate([accel[:1], accel[:-1]]))


# blocks ---------------------------------------------------------------------------------------------------------------
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


def measured_readings(data: DriveData) -> FloatArray:
    """(channel, row)."""
    return np.stack([x for x in (data.accel, data.speed) if x is not None])


def compared(data: DriveData, rows: FloatArray) -> list[FloatArray]:
    """Readings (channel, row) as the channels that the likelihood compares: acceleration and differenced speed."""
    return data.channel_rows(None if data.accel is None else rows[0], None if data.speed is None else rows[-1])
