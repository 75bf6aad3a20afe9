"""A demanded acceleration through dead time and first-order lag, and both fitted by least squares.

Rows are means of acceleration over a second, summed up by block: leaving blocks out then costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import nnls
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.pedals.pedal_drive import PedalDrive, Piece


def delayed(demand: FloatArray, dead_time: float, dt: float) -> FloatArray:
    """`demand` (cell, ...) later by `dead_time` [s]; before its beginning it was as at its first cell."""
    whole, part = int(dead_time / dt), dead_time / dt - int(dead_time / dt)

    def later(cells: int) -> FloatArray:
        return demand[np.maximum(np.arange(len(demand)) - cells, 0)]

    # a cell holds the end of one demand and the beginning of the next
    return later(whole) if part < 1e-9 else (1 - part) * later(whole) + part * later(whole + 1)


def speed_gained(demand: FloatArray, T_L: float, dt: float) -> tuple[FloatArray, FloatArray]:
    """What a lag `T_L` [s] makes of `demand` (cell, ...): speed gained in each cell [m/s], and the acceleration at its
    beginning [m/s²]. At the first cell the car is steady."""
    keep = np.exp(-dt / T_L)
    accel, _ = lfilter([0.0, 1 - keep], [1.0, -keep], demand, axis=0, zi=demand[:1] * 1.0)
    return demand * dt + (accel - demand) * T_L * (1 - keep), accel


_RIDGE = 1e-9  # of the mean diagonal: columns the drive never reaches must not make the matrix singular


def bounded_solution(normal: FloatArray, right: FloatArray, free: int) -> FloatArray:
    """The x (column,) that minimises x' `normal` x - 2 `right`' x with none but the first `free` below zero."""
    scale = 1 / np.sqrt(np.diag(normal) + _RIDGE * np.trace(normal) / len(normal))
    scaled = normal * scale[:, None] * scale + _RIDGE * np.eye(len(normal))
    root = np.linalg.cholesky(scaled).T  # upper
    target = solve_triangular(root, right * scale, trans=1)
    # the free ones fit whatever the others leave of their rows, so the others see only the rows below
    x = np.empty(len(normal))
    x[free:] = nnls(root[free:, free:], target[free:])[0] if free < len(normal) else 0.0
    x[:free] = solve_triangular(root[:free, :free], target[:free] - root[:free, free:] @ x[free:])
    return x * scale


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


LAGS_S = np.geomspace(0.03, 3.0, 25)
DEAD_TIMES_S = np.arange(0.0, 0.81, 0.05)


def lag_of(rows: Sequence[Rows], demand: Sequence[FloatArray], used: BoolArray) -> tuple[float, float]:
    """Lag and dead time [s], the best of a grid, by the blocks `used` (block,); `demand` (cell,) for each of `rows`."""
    best, found = np.inf, (0.3, 0.0)
    wanted = [one.means(np.diff(one.piece.speed)) for one in rows]
    counted = [used[one.block] for one in rows]
    for dead_time in DEAD_TIMES_S.tolist():
        late = [delayed(m, dead_time, one.piece.dt) for m, one in zip(demand, rows, strict=True)]
        for T_L in LAGS_S.tolist():
            left = 0.0
            for one, m, target, counts in zip(rows, late, wanted, counted, strict=True):
                off = one.means(speed_gained(m, T_L, one.piece.dt)[0]) - target
                left += float((off[counts] ** 2).sum())
            if left < best:
                best, found = left, (T_L, dead_time)
    return found
