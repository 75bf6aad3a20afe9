"""The fit that a drive asks for: of its pedals as they were pushed, or of a commanded speed by its loop."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.arrays import BoolArray
from avtorch.io import LogSource
from avtorch.pedals.columns import MapColumns
from avtorch.pedals.fitting import Fitting, PedalFit
from avtorch.pedals.loop_fitting import LoopFitting
from avtorch.pedals.pedal_drive import PedalDrive


def fit_pedals(logs: LogSource | Sequence[LogSource]) -> PedalFit:
    """The map of the pedals of a drive, or of several drives of one car.

    Logs without pedals are fitted by their `speed_cmd`. Raises `InputError` for logs without speed or without a pedal
    or a `speed_cmd` that moves, and for less than four blocks of five seconds that count.

    Example:
        >>> import numpy as np
        >>> from avtorch import Log
        >>> from avtorch.pedals import fit_pedals
        >>> time = np.arange(0.0, 120.0, 0.05)
        >>> throttle = 0.25 + 0.15 * np.sin(0.4 * time) + 0.1 * np.sin(1.1 * time)
        >>> speed = np.empty(len(time))
        >>> v, a = 10.0, 0.0
        >>> for i, pedal in enumerate(throttle):  # 4 m/s² at full throttle, a lag of 0.4 s, and drag
        ...     speed[i] = v
        ...     v, a = v + 0.05 * a, a + 0.05 / 0.4 * (4.0 * pedal - 0.1 * v - a)
        >>> found = fit_pedals(Log.from_arrays(time=time, throttle=throttle, speed=speed))
        >>> made = found.map
        >>> round(float(made.accel(np.array([8.0]), throttle=np.array([0.3]))[0]), 1), round(made.T_L, 1)
        (0.4, 0.4)
    """
    return fit_drive(PedalDrive.of(logs))


def fit_drive(drive: PedalDrive, blocks: BoolArray | None = None, *, errors: bool = True) -> PedalFit:
    """The map by those `blocks` (block,) of a drive that are true, by default all of them; `errors`: with standard
    errors."""
    used = np.ones(drive.blocks, bool) if blocks is None else blocks
    columns = MapColumns.for_drive(drive)
    fitting = LoopFitting if drive.is_loop else Fitting
    return fitting(drive, columns, used).fit(errors)
