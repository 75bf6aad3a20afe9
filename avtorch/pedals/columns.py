"""The map as a sum of columns: what each of its knots adds to the acceleration, linear in what is fitted.

Coasting is free in sign: engine braking, rolling resistance and drag slow the car, creep does not. What a pedal adds is
a sum of ramps, one for each interval between its knots, times hats over speed, with factors of one sign. So it is
monotone in the pedal at every speed, and a dead zone or a saturation is a ramp of height zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.pedals.pedal_drive import PedalDrive, Piece
from avtorch.pedals.pedal_map import RATE, SIGN, PedalMap, PedalTable, place

_SECONDS_A_KNOT = 12.0
_PEDAL_KNOTS, _SPEED_KNOTS, _LOOP_KNOTS = (3, 8), (2, 7), (2, 4)
_OUTLYING = 0.001  # of the cells may lie beyond the outermost knot of speed


@dataclass(frozen=True, eq=False)
class MapColumns:
    """Knots over `speed` (speed,) and of each pedal. The factors of the first `free` columns may have any sign."""

    speed: FloatArray
    pedal: dict[str, FloatArray]

    @classmethod
    def for_drive(cls, drive: PedalDrive) -> MapColumns:
        """Knots where the drive has been, more of them the longer it is."""
        many = drive.seconds / _SECONDS_A_KNOT
        v = drive.counted("speed")
        # a loop keeps to its speed, and its slope adds a straight line if anything
        across = _LOOP_KNOTS if drive.is_loop else _SPEED_KNOTS
        low, high = np.quantile(v, (_OUTLYING, 1 - _OUTLYING))
        speed = _between(v[(v > low) & (v < high)], low, max(high, low + 0.1), _number(many / 2, across))
        pedal = {}
        for name in drive.names:
            x = drive.counted(name)
            knots, most = [np.zeros(1)], 2 if name == RATE else _number(many / 2, _PEDAL_KNOTS)
            if x.max() > 0:
                knots.append(_between(x[x > 0], 0.0, float(x.max()), most)[1:])
            if x.min() < 0:
                knots.append(-_between(-x[x < 0], 0.0, float(-x.min()), max(2, most // 2))[1:])
            pedal[name] = np.unique(np.concatenate(knots))
        return cls(speed, pedal)

    @property
    def free(self) -> int:
        return len(self.speed)

    @property
    def count(self) -> int:
        return self.free + sum((len(x) - 1) * len(self.speed) for x in self.pedal.values())

    def of(self, piece: Piece) -> FloatArray:
        """The columns (cell, column) [m/s² per factor] of the measured drive."""
        return self.at(piece.middle, piece.pedals)

    def at(self, speed: FloatArray, pedals: Mapping[str, FloatArray]) -> FloatArray:
        """The columns (row, column) at `speed` (row,) and `pedals` (row,) by name."""
        hats = _hats(self.speed, speed)
        out = [hats]
        for name, knots in self.pedal.items():
            ramps = SIGN[name] * _ramps(knots, pedals[name])
            out.append((ramps[:, :, None] * hats[:, None, :]).reshape(len(hats), -1))
        return np.concatenate(out, 1)

    def roughness(self) -> FloatArray:
        """Rows (row, column) whose squares sum to the map's mean squared curvature, over a pedal's and the speed's
        whole range."""
        across = _curvature(self.speed)
        rows = [np.pad(across, ((0, 0), (0, self.count - self.free)))]
        at = self.free
        for knots in self.pedal.values():
            size, width = len(knots) - 1, len(self.speed)
            summed = _summed(knots)  # from ramps to the table's rows
            along = np.kron(_curvature(knots) @ summed, np.eye(width) / np.sqrt(width))
            over = np.kron(summed / np.sqrt(len(knots)), across)
            for block in (along, over):
                rows.append(np.pad(block, ((0, 0), (at, self.count - at - size * width))))
            at += size * width
        return np.concatenate(rows)

    def map_of(self, factors: FloatArray, sd: FloatArray | None, T_L: float, dead_time: float) -> PedalMap:
        """The map of `factors` (column,); `sd` (draw, column): changes of them by which its errors are told."""
        pedals, at, width = {}, self.free, len(self.speed)
        for name, knots in self.pedal.items():
            size = (len(knots) - 1) * width
            make = SIGN[name] * _summed(knots)
            accel = make @ factors[at : at + size].reshape(-1, width)
            # the factors are not negative, yet by round-off a knot of a sum may fall below the one before
            accel = SIGN[name] * np.maximum.accumulate(SIGN[name] * accel)
            spread = None if sd is None else _sd(make @ sd[:, at : at + size].reshape(len(sd), -1, width))
            pedals[name] = PedalTable(knots, accel, spread)
            at += size
        coasting = None if sd is None else _sd(sd[:, : self.free])
        return PedalMap(self.speed, factors[: self.free], pedals, T_L, dead_time, coasting)


def _sd(changes: FloatArray) -> FloatArray:
    return np.sqrt((changes**2).sum(0))


def _number(wanted: float, limits: tuple[int, int]) -> int:
    return int(np.clip(wanted, *limits))


def _between(values: FloatArray, low: float, high: float, number: int) -> FloatArray:
    """Knots from `low` to `high`, halfway between even ones and those with equal shares of the values."""
    share = np.linspace(0.0, 1.0, number)
    even = low + (high - low) * share
    found = np.quantile(values, share) if len(values) else even
    knots = 0.5 * (even + np.clip(found, low, high))
    knots[0], knots[-1] = low, high
    return np.unique(knots)


def _hats(knots: FloatArray, at: FloatArray) -> FloatArray:
    number, share = place(knots, at)
    out = np.zeros((len(at), len(knots)))
    rows = np.arange(len(at))
    out[rows, number] = 1 - share
    out[rows, number + 1] = share
    return out


def _ramps(knots: FloatArray, at: FloatArray) -> FloatArray:
    """How much of each interval lies between zero and the value (cell, interval), negative where that is below zero."""
    share = np.clip((at[:, None] - knots[:-1]) / np.diff(knots), 0.0, 1.0)
    return share - (knots[1:] <= 0)


def _summed(knots: FloatArray) -> FloatArray:
    """From ramps to the values at the knots (knot, interval)."""
    return _ramps(knots, knots)


def _curvature(knots: FloatArray) -> FloatArray:
    """Differences of slopes (knot - 2, knot), whose squares sum to the integral of the squared second derivative."""
    steps = np.diff(knots) / (knots[-1] - knots[0])
    out = np.zeros((max(len(knots) - 2, 0), len(knots)))
    for i in range(len(out)):
        out[i, i], out[i, i + 2] = 1 / steps[i], 1 / steps[i + 1]
        out[i, i + 1] = -out[i, i] - out[i, i + 2]
        out[i] /= np.sqrt(0.5 * (steps[i] + steps[i + 1]))
    return out
