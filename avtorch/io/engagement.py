"""Returns to the automation after a driver was in charge: the first rows that are informative about the car again.

While `engaged` is 0 the car does not obey the command. At the return, the states of the actuator and of the sensors'
filters are unknown, and so is whether delayed commands still arrive. Rows count once both have decayed.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.io.clock import ROUNDING_S

SETTLE_S = 2.0
"""From a drive's start or a return to `engaged` until the state of actuator and sensors is known: dead time and lag."""


def settled_rows(
    time: FloatArray, engaged: BoolArray, driven: FloatArray | float = -np.inf
) -> tuple[BoolArray, FloatArray]:
    """Rows `SETTLE_S` or more past the return, (..., time), and when the driver was last in charge [s], (...).

    `time` (time,) [s], rising; `engaged` (..., time); `driven` (...): when the driver was last in charge before the
    first row, -inf: never.
    """
    last = np.broadcast_to(np.asarray(driven, np.float64), engaged.shape[:-1])[..., None]
    last = np.concatenate([last, np.where(engaged, -np.inf, time)], -1)
    last = np.maximum.accumulate(last, -1)
    # the return lies one row after the last one driven
    return time - last[..., 1:] > SETTLE_S + ROUNDING_S, last[..., -1]
