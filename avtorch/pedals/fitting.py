"""Fits a map of pedals together with the lag and the dead time that follow it.

The car gains dv/dt = a, T_L da/dt = m(pedal, v) - a, the pedal late by the dead time. For given lag and dead time this
is linear in the map's factors, so each candidate is one bounded least squares; how smooth the map is, blocks that are
held out decide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.pedals.columns import MapColumns
from avtorch.pedals.lagged import (
    DEAD_TIMES_S,
    LAGS_S,
    bounded_solution,
    lag_of,
    normal_equations,
    rows_of,
    speed_gained,
)
from avtorch.pedals.pedal_drive import PedalDrive, Piece
from avtorch.pedals.pedal_map import PedalMap

_SMOOTH = np.geomspace(1e-7, 10.0, 9)
_FIRST_SMOOTH = 1e-3
_ROUGHER = 0.01
ENOUGH = 1e-6  # of the squares left: a step that gains less ends the search
_ROUNDS = 8
_FOLDS = 8


@dataclass(frozen=True, eq=False)
class PedalFit:
    """A fitted map with what is known of its errors.

    Standard errors are by blocks [s], of the lag of `map`, of its dead time and of their sum (nan where they were not
    asked for); the sum, how late the car is, is known far better than its parts. `smooth`: weight of the map's
    curvature, chosen by blocks held out; `rms` [m/s²]: what the fit leaves of accelerations over a second; `seconds`:
    how long a drive it saw.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import fit_pedals
        >>> time = np.arange(0.0, 60.0, 0.05)
        >>> throttle = 0.3 + 0.2 * np.sin(0.5 * time)
        >>> speed = 15.0 + 1.2 * np.sin(0.5 * time - np.pi / 2)
        >>> found = fit_pedals(Log.from_arrays(time=time, throttle=throttle, speed=speed))
        >>> sorted(found.map.pedals), found.seconds > 55, found.rms < 0.1
        (['throttle'], True, True)
    """

    map: PedalMap
    T_L_sd: float
    dead_time_sd: float
    late_sd: float
    smooth: float
    rms: float
    seconds: float


class Fitting:
    """One fit, of the blocks `used` (block,) of a drive."""

    def __init__(self, drive: PedalDrive, columns: MapColumns, used: BoolArray) -> None:
        self.drive, self.columns, self.used = drive, columns, used
        self.rows = rows_of(drive)
        self.count = float(sum(used[one.block].sum() for one in self.rows))
        self.made = {id(piece): columns.of(piece) for piece in drive.pieces}
        rough = columns.roughness()
        self.rough = rough.T @ rough

    def fit(self, errors: bool) -> PedalFit:
        """The map, with standard errors or without."""
        T_L, dead_time, factors, smooth, rougher = self.found()
        rms = float(np.sqrt(self._left(factors, self._products(T_L, dead_time)[self.used].sum(0)) / self.count))
        spread, sd = None, (np.nan, np.nan, np.nan)
        if errors:
            spread, sd = self._errors(factors, T_L, dead_time, rougher)
        made = self.columns.map_of(factors, spread, T_L, dead_time)
        return PedalFit(made, sd[0], sd[1], sd[2], smooth, rms, self.drive.seconds)

    def found(self) -> tuple[float, float, FloatArray, float, float]:
        """Lag, dead time and factors, the weight of curvature, and the lower one by which errors are told."""
        T_L, dead_time, smooth = 0.3, 0.0, _FIRST_SMOOTH
        for _ in range(_ROUNDS):
            each = self._products(T_L, dead_time)
            factors = self._factors(each[self.used].sum(0), smooth)
            before = T_L, dead_time
            T_L, dead_time = self._lag(factors)
            if (T_L, dead_time) == before:
                break
        smooth, rougher = self._smooth(self._products(T_L, dead_time))
        return *self._refined(T_L, dead_time, smooth), smooth, rougher

    def _refined(self, T_L: float, dead_time: float, smooth: float) -> tuple[float, float, FloatArray]:
        """Lag and dead time from those of a grid to between its points, and the factors, while the fit gets better."""
        factors, left = self._solved(T_L, dead_time, smooth)
        for _ in range(_ROUNDS):
            joint = self._with_slopes(factors, T_L, dead_time)[self.used].sum(0)
            step = self._jointly(joint, smooth)[:2]
            new = float(np.clip(T_L + step[0], max(0.7 * T_L, LAGS_S[0]), min(1.4 * T_L, LAGS_S[-1])))
            late = float(np.clip(dead_time + step[1], 0.0, DEAD_TIMES_S[-1]))
            tried, less = self._solved(new, late, smooth)
            if less >= left * (1 - ENOUGH):
                break
            T_L, dead_time, factors, left = new, late, tried, less
        return T_L, dead_time, factors

    def _solved(self, T_L: float, dead_time: float, smooth: float) -> tuple[FloatArray, float]:
        """The factors, and the sum of squares they leave."""
        whole = self._products(T_L, dead_time)[self.used].sum(0)
        factors = self._factors(whole, smooth)
        return factors, self._left(factors, whole)

    def _left(self, factors: FloatArray, products: FloatArray) -> float:
        tested = np.append(factors, -1.0)
        return max(float(tested @ products @ tested), 0.0)

    def _products(self, T_L: float, dead_time: float) -> FloatArray:
        return normal_equations(self.rows, lambda p: self.made[id(p)], T_L, dead_time, self.drive.blocks)

    def _factors(self, products: FloatArray, smooth: float) -> FloatArray:
        count = self.columns.count
        # curvature counts by the rows, so that a longer drive is not fitted more smoothly
        normal = products[:count, :count] + smooth * self.count * self.rough
        return bounded_solution(normal, products[:count, -1], self.columns.free)

    def _smooth(self, each: FloatArray) -> tuple[float, float]:
        """The weight of curvature with which blocks that are held out are predicted best; and one so small that a
        corner, too, is followed: the smallest of those that do as well, to one standard error of the difference, or a
        hundredth of the best."""
        numbers = np.flatnonzero(self.used)
        folds = min(_FOLDS, len(numbers))
        whole, left = each[self.used].sum(0), np.zeros((len(_SMOOTH), len(numbers)))
        for fold in range(folds):
            out = np.arange(len(numbers)) % folds == fold
            held = each[numbers[out]]
            for i, smooth in enumerate(_SMOOTH.tolist()):
                x = np.append(self._factors(whole - held.sum(0), smooth), -1.0)
                left[i, out] = np.einsum("i,bij,j->b", x, held, x)
        best = int(left.sum(1).argmin())
        more = left - left[best]
        error = more.std(1, ddof=1) * np.sqrt(len(numbers))
        smooth = float(_SMOOTH[best])
        return smooth, min(float(_SMOOTH[more.sum(1) <= error].min()), _ROUGHER * smooth)

    def _lag(self, factors: FloatArray) -> tuple[float, float]:
        return lag_of(self.rows, [self.made[id(one.piece)] @ factors for one in self.rows], self.used)

    def _with_slopes(self, factors: FloatArray, T_L: float, dead_time: float) -> FloatArray:
        """Products as `_products`, with two columns before the others: what the response to `factors` changes by with
        lag and dead time."""

        def demand(piece: Piece) -> FloatArray:
            made = self.made[id(piece)]
            m = made @ factors
            gained, _ = speed_gained(m, T_L, piece.dt)
            # demands whose response, through the same lag and dead time, is that slope
            return np.column_stack([(gained / piece.dt - m) / T_L, -np.gradient(m, piece.dt), made])

        return normal_equations(self.rows, demand, T_L, dead_time, self.drive.blocks)

    def _jointly(self, products: FloatArray, smooth: float) -> FloatArray:
        """Steps of lag and dead time, and the factors, of products with slopes."""
        rough = np.pad(self.rough, ((2, 0), (2, 0)))
        normal = products[:-1, :-1] + smooth * self.count * rough
        return bounded_solution(normal, products[:-1, -1], self.columns.free + 2)

    def _errors(
        self, factors: FloatArray, T_L: float, dead_time: float, rougher: float
    ) -> tuple[FloatArray, tuple[float, float, float]]:
        """By leaving out each block: changes of the factors (draw, column) whose squares sum to variances, and the
        standard errors of lag, dead time and their sum, which are fitted with them to first order.

        They are those of a map fitted with the weight `rougher`, and the difference to that one is added as one more
        change: blocks left out do not show what smoothing does to all of them alike.
        """
        each = self._with_slopes(factors, T_L, dead_time)
        whole, numbers = each[self.used].sum(0), np.flatnonzero(self.used)
        kept = np.stack([self._jointly(whole - each[number], rougher) for number in numbers])
        changes = (kept - kept.mean(0)) * np.sqrt((len(numbers) - 1) / len(numbers))
        lag_sd, dead_sd = np.sqrt((changes[:, :2] ** 2).sum(0))
        late_sd = np.sqrt((changes[:, :2].sum(1) ** 2).sum())
        smoothed = self._factors(whole[2:, 2:], rougher) - factors
        return np.vstack([changes[:, 2:], smoothed]), (float(lag_sd), float(dead_sd), float(late_sd))
