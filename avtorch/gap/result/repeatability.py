"""What noise alone leaves, told without any model: commands that the car was given twice.

Two windows with the same commands, which had been the same for some seconds before, find the actuator in the same
state. Half the mean square of what the car did differently is then noise, and whatever else the commands do not decide
(another speed, a slope, an onset between the two): a floor that no fit has touched.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.record import Record

WINDOW_S = 10.0
SETTLED_S = 3.0
"""From a window's start, after which the actuator has forgotten what came before [s]."""
_ALIKE = 0.02  # of the spread of the commands themselves
_LIVELY_MPS2 = 0.2


@dataclass(frozen=True)
class Repeatability:
    """From so many `pairs` of windows: `seconds` [s] compared, root mean squares `accel` [m/s²] and `speed` [m/s].

    The speed's is of its change since the window settled. None where the log lacks the channel.
    """

    pairs: int
    seconds: float
    accel: float | None
    speed: float | None

    def to_dict(self) -> dict[str, Any]:
        """The object `repeatability` of `gap` in `diagnosis.json`."""
        return {
            "pairs": self.pairs,
            "seconds": self.seconds,
            "floor_accel": self.accel,
            "floor_speed": self.speed,
        }


def repeatability(record: Record) -> Repeatability | None:
    """Of the windows that a record holds twice; None where it holds none."""
    rows, settled = round(WINDOW_S / record.dt), round(SETTLED_S / record.dt)
    found = list(_pairs(record.command[record.source], record.stretch, rows))
    if not found:
        return None
    floors: dict[str, float] = {}
    for name, seen in zip(record.channels, record.measured, strict=True):
        each = []
        for first, second in found:
            one, other = (seen[k + settled : k + rows].ravel() for k in (first, second))
            if name == "speed":
                one, other = one - one[0], other - other[0]
            each.append(one - other)
        floors[name] = float(np.sqrt(0.5 * np.mean(np.concatenate(each) ** 2)))
    seconds = len(found) * (rows - settled) * record.dt
    return Repeatability(len(found), seconds, floors.get("accel"), floors.get("speed"))


def _pairs(command: FloatArray, stretch: NDArray[np.intp], rows: int) -> list[tuple[int, int]]:
    """Where windows of so many rows begin that have the same commands; no row is in two windows."""
    last = len(command) - rows
    if last < rows:
        return []
    whole = stretch[: last + 1] == stretch[rows - 1 :]
    sums = np.concatenate([[0.0], np.cumsum(command**2)])
    squares = sums[rows:] - sums[:-rows]
    free = np.ones(len(command), bool)
    found = []
    for first in range(0, last + 1, max(rows // 2, 1)):
        own = command[first : first + rows]
        if not whole[first] or not free[first : first + rows].all() or own.std() < _LIVELY_MPS2:
            continue
        away = (squares + squares[first] - 2 * fftconvolve(command, own[::-1], "valid")) / rows
        away[: first + rows] = np.inf
        away[~whole] = np.inf
        second = int(away.argmin())
        if away[second] <= (_ALIKE * own.std()) ** 2 and free[second : second + rows].all():
            free[first : first + rows] = free[second : second + rows] = False
            found.append((first, second))
    return found
