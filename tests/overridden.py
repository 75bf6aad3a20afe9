"""A car whose driver takes over now and then and acts against the command, by formulas of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avtorch.io import Log
from tests.gap.records import command_over

_STEPS = 10  # of the car between two rows
_DRIVER_LAG_S = 0.25
_DRIVER_MPS2 = 1.6


def taken_over(
    *,
    seconds: float,
    overrides: Sequence[tuple[float, float]],
    rng: np.random.Generator,
    rate_hz: int = 20,
    T_L: float = 0.35,
    K_L: float = 1.0,
    brake_gain_ratio: float = 1.0,
    delay_s: float = 0.0,
    jerk: bool = False,
    noise: float = 1.0,
) -> Log:
    """First order with lag `T_L`, gain `K_L` (times the ratio where the late command brakes) and a delay.

    In `overrides` (begin, end) [s] nobody obeys the command: the driver accelerates where it brakes and brakes where it
    accelerates, and `engaged` is 0. At a return the actuator begins where the driver left the car, at no demand until
    the first command since then arrives. `noise`: size of the sensors', as a share of good ones.
    """
    rows, dt = round(seconds * rate_hz), 1 / rate_hz
    step, wait = dt / _STEPS, round(delay_s * rate_hz * _STEPS)
    time = np.arange(rows, dtype=np.float64) * dt
    driven = np.zeros(rows, bool)
    for begin, end in overrides:
        driven |= (time >= begin) & (time < end)
    demand = command_over(time)
    sent = np.zeros(rows * _STEPS)
    command, accel, speed, slope = np.zeros(rows), np.zeros(rows), np.zeros(rows), np.zeros(rows)
    a, v, returned = 0.0, 18.0, 0
    for k in range(rows):
        if k and driven[k - 1] and not driven[k]:
            returned = k * _STEPS
        # a loop around the speed keeps the car on the road
        command[k] = demand[k] + 0.08 * (18.0 - v)
        accel[k], speed[k] = a, v
        for i in range(k * _STEPS, (k + 1) * _STEPS):
            sent[i] = command[k]
            u = 0.0 if returned > 0 and i - wait < returned else sent[max(i - wait, 0)]
            lag, target = T_L, K_L * u * (brake_gain_ratio if u < 0 else 1.0)
            if driven[k]:
                lag, target = _DRIVER_LAG_S, _DRIVER_MPS2 if (u < 0 and v < 30) or v < 7 else -_DRIVER_MPS2
            if i == k * _STEPS:
                slope[k] = (target - a) / lag
            keep = np.exp(-step / lag)
            v += target * step + (a - target) * lag * (1 - keep)
            a = target + (a - target) * keep
    drawn = rng.standard_normal((3, rows)) * noise
    columns = {"jerk": slope + 0.1 * drawn[2]} if jerk else {}
    return Log.from_arrays(
        name="drive",
        time=time,
        accel_cmd=command,
        accel=accel + 0.03 * drawn[0],
        speed=speed + 0.02 * drawn[1],
        engaged=(~driven).astype(float),
        **columns,
    )


def deleted(log: Log) -> Log:
    """The log without the rows in which the driver was in charge, each rest a segment of its own."""
    keep = log.engaged
    number = np.cumsum(np.diff(keep.astype(int), prepend=0) == 1)
    names = [n for n in ("time", "accel_cmd", "accel", "speed", "jerk") if getattr(log, n) is not None]
    columns = {n: getattr(log, n)[keep] for n in names}
    return Log.from_arrays(name=log.name, segment=number[keep], **columns)
