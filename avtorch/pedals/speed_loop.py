"""A commanded speed as what its controller acts on: the speed that is missing, and how fast the command moves.

The controller inside such a car demands m = f(speed_cmd - speed, speed) + g(d speed_cmd/dt, speed). Both stand in a map
as pedals do: more of either never slows the car.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io import Log

ERROR, RATE = "speed_error", "speed_cmd_rate"
_HALF_S = 0.1  # a command that is held over two rows of 10 Hz does not jump
_JUMP_MPS2 = 10.0  # no car does it


def rate_of(log: Log) -> FloatArray:
    """How fast `speed_cmd` of a log moves (row,) [m/s²], over a fifth of a second about each row."""
    assert log.speed_cmd is not None
    out = np.zeros(log.rows)
    for part in log.segments():
        time, values = log.elapsed[part], log.speed_cmd[part]
        if len(time) < 2:
            continue
        half = max(_HALF_S, float(np.median(np.diff(time))))
        before, after = np.maximum(time - half, time[0]), np.minimum(time + half, time[-1])
        out[part] = (np.interp(after, time, values) - np.interp(before, time, values)) / (after - before)
    return out


def jumps(log: Log) -> bool:
    """Whether `speed_cmd` jumps, as a set speed does: no controller then adds its slope to what it demands."""
    return bool((np.abs(rate_of(log)[log.usable]) > _JUMP_MPS2).any())


def inputs_of(log: Log, names: Iterable[str]) -> dict[str, FloatArray | None]:
    """What a map takes, by name (row,): pedals of a log, or what its commanded speed asks; None for what it lacks."""
    out: dict[str, FloatArray | None] = {}
    for name in names:
        if name not in (ERROR, RATE):
            out[name] = getattr(log, name)
        elif log.speed_cmd is None or log.speed is None:
            out[name] = None
        else:
            out[name] = rate_of(log) if name == RATE else log.speed_cmd - np.maximum(log.speed, 0.0)
    return out
