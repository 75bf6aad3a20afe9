"""Returns to the automation after a driver was in charge: from where on its rows say something of the car.

While `engaged` is 0 nobody obeys the command. Where the actuator and the sensors' filters stand at the return is not
known, and whether commands that were on their way still arrive is not known either, so rows count once both are
forgotten.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.io.clock import ROUNDING_S

SETTLE_S = 2.0
"""From a drive's start or a return to `engaged` until the state of actuator and sensors is known: dead time and lag."""


def settled(time: FloatArray, engaged: BoolArray, driven: FloatArray | float = -np.inf) -> tuple[BoolArray, FloatArray]:
    """Rows `SETTLE_S` or more past the return, (..., time), and when the driver was last in charge [s], (...).

    `time` (time,) [s], rising; `engaged` (..., time); `driven` (...): when the driver was last in charge before the
    first row, -inf: never.
    """
    last = np.broadcast_to(np.asarray(driven, np.float64), engaged.shape[:-1])[..., None]
    last = np.concatenate([last, np.where(engaged, -np.inf, time)], -1)
    last = np.maximum.accumulate(last, -1)
    # the return lies one row after the last one driven
    return time - last[..., 1:] > SETTLE_S + ROUNDING_S, last[..., -1]
