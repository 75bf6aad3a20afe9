"""Fits the map of a commanded speed by closing its loop: rolled out from the command alone, it has to make the speed.

What the controller sees holds the answer: wind slows the car, and the controller gives more, so a regression on the
measured error finds too weak a controller, and noise of speed does likewise. In a rollout the error is that of the
speed rolled out, which neither wind nor noise has touched. Each step is a bounded least squares of the rollout's
slopes, in which what was missed a row before counts as known: wind and road last.

A rollout begins a block's length before the block, where the drive allows: how it began has faded when it counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.pedals.columns import MapColumns
from avtorch.pedals.fitting import ENOUGH, Fitting
from avtorch.pedals.lagged import DEAD_TIMES_S, LAGS_S
from avtorch.pedals.pedal_drive import Piece

_STRIDE_S = 0.25
_BEGIN_S = 1.0  # over which speed and acceleration at the beginning are averaged
_H_MPS = 1e-6


@dataclass(frozen=True, eq=False)
class Loop:
    """In each row, a quarter of a second after the one before of the same `block` (row,): the speed `missed` (row,)
    [m/s], measured minus rolled out, and the `slopes` (row, 2 + column) of the latter by lag, dead time and factors
    (none without slopes)."""

    block: IntArray
    missed: FloatArray
    slopes: FloatArray

    def kept(self, used: BoolArray) -> tuple[float, float]:
        """Products of what is missed with what was missed a row before, and the squares of the latter, in blocks that
        are `used` (block,)."""
        now, then = self.missed[1:], self.missed[:-1]
        same = (self.block[1:] == self.block[:-1]) & used[self.block[1:]]
        return float((now * then)[same].sum()), float((then**2)[same].sum())

    def new(self, values: FloatArray, share: float) -> FloatArray:
        """Of values (row, ...), what is new in each row where that `share` is left of the one before."""
        out = values.copy()
        first = np.concatenate([[True], self.block[1:] != self.block[:-1]])
        out[1:] -= share * values[:-1]
        out[first] = np.sqrt(1 - share**2) * values[first]
        return out


def roll(piece: Piece, columns: MapColumns, factors: FloatArray, T_L: float, dead_time: float, *, slopes: bool) -> Loop:
    """Roll out the blocks of one piece, all at the same time."""
    start, length, begin = _spans(piece)
    dt, keep = piece.dt, np.exp(-piece.dt / T_L)
    keep_by_lag = keep * dt / T_L**2
    whole, part = int(dead_time / dt), dead_time / dt - int(dead_time / dt)
    stride = max(1, round(_STRIDE_S / dt))
    v, a = _beginning(piece, begin)
    width = 2 + len(factors) if slopes else 0
    dv, da = np.zeros((2, len(start), width))
    demands: list[tuple[FloatArray, FloatArray]] = []
    block, missed, by = [], [], []
    for step in range(int((start - begin + length).max(initial=0))):
        cell = np.minimum(begin + step, piece.cells - 1)
        into = begin + step - start
        rows = np.flatnonzero((into >= 0) & (into < length) & (into % stride == 0))
        if len(rows):
            block.append(piece.block[cell[rows]])
            missed.append(piece.speed[cell[rows]] - v[rows])
            by.append(dv[rows])
        demands.append(_demand(piece, columns, factors, cell, v + 0.5 * dt * a, dv + 0.5 * dt * da))
        (now, d_now), (then, d_then) = (demands[max(step - cells, 0)] for cells in (whole, whole + 1))
        m = (1 - part) * now + part * then
        if slopes:
            dm = (1 - part) * d_now + part * d_then
            dm[:, 1] += (then - now) / dt
            dv = dv + dm * dt + (da - dm) * T_L * (1 - keep)
            dv[:, 0] += (a - m) * (1 - keep - T_L * keep_by_lag)
            da = keep * da + (1 - keep) * dm
            da[:, 0] += keep_by_lag * (a - m)
        v = v + m * dt + (a - m) * T_L * (1 - keep)
        a = keep * a + (1 - keep) * m
        stands = v <= 0
        if stands.any():
            v, dv[stands] = np.maximum(v, 0.0), 0.0
    if not block:
        return Loop(np.zeros(0, int), np.zeros(0), np.zeros((0, width)))
    number = np.concatenate(block)
    order = np.argsort(number, kind="stable")
    return Loop(number[order], np.concatenate(missed)[order], np.concatenate(by)[order])


def _spans(piece: Piece) -> tuple[IntArray, IntArray, IntArray]:
    """First cell of each block (block,), its length, and the cell its rollout begins at."""
    inside = np.flatnonzero(piece.block >= 0)
    _, first, length = np.unique(piece.block[inside], return_index=True, return_counts=True)
    start = inside[first]
    opens = np.flatnonzero((piece.block >= 0) & (np.concatenate([[-1], piece.block[:-1]]) < 0))
    run = opens[np.searchsorted(opens, start, side="right") - 1] if len(start) else start
    return start, length, np.maximum(start - length, run)


def _beginning(piece: Piece, begin: IntArray) -> tuple[FloatArray, FloatArray]:
    """Speed and acceleration (block,) at cells (block,), by a line through the second about them."""
    half = max(1, round(_BEGIN_S / piece.dt / 2))
    at = np.clip(begin[:, None] + np.arange(-half, half + 1), 0, piece.cells)
    time = (at - begin[:, None]) * piece.dt
    speed = piece.speed[at]
    off = time - time.mean(1, keepdims=True)
    slope = (off * speed).sum(1) / (off**2).sum(1)
    return np.maximum(speed.mean(1) - slope * time.mean(1), 0.0), slope


def _demand(
    piece: Piece, columns: MapColumns, factors: FloatArray, cell: IntArray, speed: FloatArray, slopes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The acceleration demanded (block,), and what it changes by (block, 2 + column) with each parameter."""
    if not slopes.shape[1]:
        return columns.at(np.maximum(speed, 0.0), piece.inputs(cell, speed)) @ factors, slopes
    near = np.concatenate([speed, speed + _H_MPS, speed - _H_MPS])
    made = columns.at(np.maximum(near, 0.0), piece.inputs(np.tile(cell, 3), near))
    here, more, less = (made @ factors).reshape(3, -1)
    by = ((more - less) / (2 * _H_MPS))[:, None] * slopes
    by[:, 2:] += made[: len(speed)]
    return here, by


_ROUNDS = 12
_SETTLES = 3  # in the first of which it is seen how wind and noise are to be weighed
_HALVINGS = 4


@dataclass(frozen=True, eq=False)
class _Point:
    factors: FloatArray
    T_L: float
    dead_time: float

    def towards(self, factors: FloatArray, step: FloatArray, share: float) -> _Point:
        # what a step of Gauss and Newton says of lags far from its own is not to be followed
        T_L = np.clip(self.T_L + share * step[0], max(0.7 * self.T_L, LAGS_S[0]), min(1.4 * self.T_L, LAGS_S[-1]))
        late = np.clip(self.dead_time + share * step[1], 0.0, DEAD_TIMES_S[-1])
        return _Point(self.factors + share * (factors - self.factors), float(T_L), float(late))


class LoopFitting(Fitting):
    """As `Fitting`, by rollouts; what that finds is where they begin."""

    kept = 0.0

    def found(self) -> tuple[float, float, FloatArray, float, float]:
        T_L, dead_time, factors, *_ = Fitting(self.drive, self.columns, self.used).found()
        at = _Point(factors, T_L, dead_time)
        smooth, rougher = 0.0, 0.0
        for number in range(_ROUNDS):
            if number < _SETTLES:
                self.kept = self._kept(at)
            each = self._with_slopes(at.factors, at.T_L, at.dead_time)
            if number < _SETTLES:
                smooth, rougher = self._smooth(each[:, 2:, 2:])
            made = self._jointly(each[self.used].sum(0), smooth)
            left = self._cost(at, smooth)
            for halving in range(_HALVINGS):
                tried = at.towards(made[2:], made[:2], 0.5**halving)
                less = self._cost(tried, smooth)
                if less < left:
                    break
            else:
                break
            at = tried
            if less >= left * (1 - ENOUGH):
                break
        return at.T_L, at.dead_time, at.factors, smooth, rougher

    def _kept(self, at: _Point) -> float:
        """The share of what is missed that is still missed a row later: wind and road last for seconds."""
        found = [one.kept(self.used) for one in self._rolled(at.factors, at.T_L, at.dead_time, slopes=False)]
        products, squares = np.sum(found, 0)
        return float(np.clip(products / max(squares, 1e-12), 0.0, 0.99))

    def _cost(self, at: _Point, smooth: float) -> float:
        squares = sum(
            float((one.new(one.missed, self.kept)[self.used[one.block]] ** 2).sum())
            for one in self._rolled(at.factors, at.T_L, at.dead_time, slopes=False)
        )
        return squares + smooth * self.count * float(at.factors @ self.rough @ at.factors)

    def _rolled(self, factors: FloatArray, T_L: float, dead_time: float, *, slopes: bool) -> list[Loop]:
        return [roll(piece, self.columns, factors, T_L, dead_time, slopes=slopes) for piece in self.drive.pieces]

    def _with_slopes(self, factors: FloatArray, T_L: float, dead_time: float) -> FloatArray:
        """Products (block, column + 1, column + 1) of what speed changes by with lag, dead time and factors, the last
        column being what the factors would have to make of it."""
        size = len(factors) + 3
        out = np.zeros((self.drive.blocks, size, size))
        for one in self._rolled(factors, T_L, dead_time, slopes=True):
            every = one.new(np.column_stack([one.slopes, one.missed + one.slopes[:, 2:] @ factors]), self.kept)
            for number in np.unique(one.block):
                part = every[one.block == number]
                out[number] += part.T @ part
        return out
