"""Free runs on blocks of the drives: no measurement corrects the simulated speed for `HORIZON_S`.

Commands, and the speed that effects read, are the log's. Blocks are groups of neighbouring hops of the lapped
transform's frames, dealt into folds; with several drives of similar length whole drives are held out. Frames that reach
into a held-out block teach nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.answer.budget import BEGIN_S, HORIZON_S
from avtorch.gap.engine.compiled_plant import read_late
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis

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

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.gap.engine.drive_data import DriveData
        >>> log = simulate(Leader.default(start=30.0, duration=120.0, dt=0.05)).log()
        >>> blocks = Blocks.of(DriveData.of(log))
        >>> len(blocks.rows), blocks.taught.shape[0], blocks.by_drives
        (9, 5, False)
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

    def stitched(self, of_folds: Sequence[FloatArray]) -> FloatArray:
        """(channel, row): each block's by the fit that was made without it; 0 outside."""
        out = np.zeros_like(of_folds[0])
        for rows, k in zip(self.rows, self.fold, strict=True):
            out[:, rows] = of_folds[k][:, rows]
        return out

    def free_runs(self, data: DriveData, errors: FloatArray) -> FloatArray:
        """Errors (..., channel, row) of readings as those of free runs, begun anew every `HORIZON_S` in each block.

        A speed begins at its measured mean over the first `BEGIN_S`.
        """
        out = errors.copy()
        if data.speed is None:
            return out
        span, begin = round(HORIZON_S / data.dt), max(1, round(BEGIN_S / data.dt))
        for block in self.rows:
            for i in range(block.start, block.stop, span):
                run = out[..., -1, i : min(i + span, block.stop)]
                run -= run[..., :begin].mean(-1, keepdims=True)
        return out


def readings(h: Hypothesis, accel: FloatArray, gained: FloatArray) -> FloatArray:
    """Grid signals as the recorder shows them: (channel, row) of acceleration [m/s²] and speed gained [m/s]."""
    data, grid, out = h.data, h.data.grid, []
    if data.accel is not None:
        a = np.empty(len(data.time))
        read_late(data.time, grid.time, accel, h["accel_delay"], a)
        out.append(data.low_pass(a, h["accel_filter"]))
    if data.speed is not None:
        v = np.empty(len(data.time))
        read_late(data.time, grid.time, gained, h["speed_delay"], v)
        out.append(data.held(data.low_pass(v, h["speed_filter"])))
    return np.stack(out)


def measured_readings(data: DriveData) -> FloatArray:
    """(channel, row)."""
    return np.stack([x for x in (data.accel, data.speed) if x is not None])


def compared(data: DriveData, rows: FloatArray) -> list[FloatArray]:
    """Readings (channel, row) as the channels that the likelihood compares: acceleration and differenced speed."""
    return data.channel_rows(None if data.accel is None else rows[0], None if data.speed is None else rows[-1])


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
