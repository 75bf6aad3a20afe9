"""Model-free noise floor, from commands that the car was given twice.

In two windows with the same commands, preceded by equal commands for some seconds, the actuator starts from the same
state. Half the mean square difference of the responses is then noise, plus whatever does not depend on the commands
(another speed, a road grade, an onset between the two): a floor that involves no fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from avtorch.arrays import FloatArray
from avtorch.gap.counted import Counted

WINDOW_S = 10.0
SETTLED_S = 3.0
"""Time from a window's start after which the actuator has forgotten its earlier state [s]."""
_ALIKE = 0.02  # tolerance, relative to the spread of the commands
_LIVELY_MPS2 = 0.2


@dataclass(frozen=True)
class Repeatability:
    """Noise floor from `pairs` pairs of windows: `seconds` [s] compared, root mean squares `accel` [m/s²] and `speed`
    [m/s].

    The speed's is of its change since the settling time. None where the log lacks the channel.
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


def repeatability(record: Counted) -> Repeatability | None:
    """The repeatability from windows with repeated commands; None where there are none."""
    rows, settled = round(WINDOW_S / record.dt), round(SETTLED_S / record.dt)
    found = list(_pairs(record.command[record.source], record.stretch, rows))
    if not found:
        return None
    floors: dict[str, float] = {}
    for name, measured in zip(record.channels, record.measured, strict=True):
        each = []
        for first, second in found:
            one, other = (measured[k + settled : k + rows].ravel() for k in (first, second))
            if name == "speed":
                one, other = one - one[0], other - other[0]
            each.append(one - other)
        floors[name] = float(np.sqrt(0.5 * np.mean(np.concatenate(each) ** 2)))
    seconds = len(found) * (rows - settled) * record.dt
    return Repeatability(len(found), seconds, floors.get("accel"), floors.get("speed"))


def _pairs(command: FloatArray, stretch: NDArray[np.intp], rows: int) -> list[tuple[int, int]]:
    """Starts of pairs of windows of `rows` rows with the same commands; no row is in two windows."""
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
