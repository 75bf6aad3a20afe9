"""Fits the map of a commanded speed by closing its loop: rolled out from the command alone, it has to make the speed.

What the controller sees holds the answer: wind slows the car, and the controller gives more, so a regression on the
measured error finds too weak a controller, and noise of speed does likewise. In a rollout the error is that of the
speed rolled out, which neither wind nor noise has touched. Each step is a bounded least squares of the rollout's
slopes, in which what was missed a row before counts as known: wind and road last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.pedals.fitting import ENOUGH, Fitting
from avtorch.pedals.lag_search import DEAD_TIMES_S, LAGS_S
from avtorch.pedals.loop_rollout import Loop, roll

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
