"""The fit's rows, means of acceleration over a second, summed up by block: leaving blocks out then costs nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.pedals.lagged import delayed, speed_gained
from avtorch.pedals.pedal_drive import PedalDrive, Piece

WINDOW_S = 1.0  # slow enough to average a speed's quanta, quick enough to show a lag of tenths of a second
_STRIDE_S = 0.25


@dataclass(frozen=True, eq=False)
class Rows:
    """Where each window of a piece begins (window,), how many cells it has, and the `block` (window,) it lies in."""

    piece: Piece
    start: IntArray
    width: int
    block: IntArray

    def means(self, gained: FloatArray) -> FloatArray:
        """Mean accelerations (window, ...) [m/s²] of what is gained in each cell (cell, ...) [m/s]."""
        summed = np.concatenate([np.zeros((1, *gained.shape[1:])), np.cumsum(gained, 0)])
        return (summed[self.start + self.width] - summed[self.start]) / (self.width * self.piece.dt)


def rows_of(drive: PedalDrive) -> list[Rows]:
    """All windows that lie in one block each."""
    found = []
    for piece in drive.pieces:
        width = max(1, round(WINDOW_S / piece.dt))
        start = np.arange(0, piece.cells - width + 1, max(1, round(_STRIDE_S / piece.dt)))
        first, last = piece.block[start], piece.block[start + width - 1]
        whole = (first >= 0) & (first == last)
        found.append(Rows(piece, start[whole], width, first[whole]))
    return found


def normal_equations(
    rows: list[Rows], demand: Callable[[Piece], FloatArray], T_L: float, dead_time: float, blocks: int
) -> FloatArray:
    """Products of all columns, the measured one last (block, column + 1, column + 1), of `demand` (cell, column)."""
    out = None
    for one in rows:
        gained, _ = speed_gained(delayed(demand(one.piece), dead_time, one.piece.dt), T_L, one.piece.dt)
        every = np.column_stack([one.means(gained), one.means(np.diff(one.piece.speed))])
        if out is None:
            out = np.zeros((blocks, every.shape[1], every.shape[1]))
        for number in np.unique(one.block):
            part = every[one.block == number]
            out[number] += part.T @ part
    assert out is not None
    return out
