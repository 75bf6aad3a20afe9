"""What a recorder did to the signals, and what the drive excites: facts a reader of the log wants in sentences."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.clock import stretches
from avtorch.io.log import Log
from avtorch.io.units import SI
from avtorch.logcheck.late_channel import late_channel

_CHANNELS = ("accel_cmd", "accel", "speed")
_COARSE = 0.005  # of a signal's SD: a last digit from which it is told
_AGREE = 0.8  # correlation of two signals whose lateness means something
_TREMBLES_HZ = 3.0
_TOLD_MPS2 = 0.02
_REST_S = 1.0  # a car that stands so long stands still


def quantum(values: FloatArray) -> float | None:
    """The step by which values (row,) are rounded, in their unit; None where there is none of a size that matters."""
    levels = np.unique(values)
    if len(levels) < 3 or values.std() == 0:
        return None
    steps = np.diff(levels)
    step = float(np.quantile(steps, 0.1))
    if step < _COARSE * values.std():
        return None
    whole = (levels - levels[0]) / step
    # float64 and conversions of units leave something of the last digit
    return step if np.mean(np.abs(whole - np.round(whole)) < 0.05) > 0.95 else None


def recorder_notes(log: Log) -> list[str]:
    """Sentences on rounding, lateness and vibration."""
    notes = []
    for name in _CHANNELS:
        values = getattr(log, name)
        if values is not None and (step := quantum(values)) is not None:
            notes.append(f"{name} is rounded to {step:.3g} {SI[name]}")
    parts = stretches(log.usable, log.segment)
    slope = None if log.speed is None else slope_of(log.elapsed, log.speed)
    if (known := late_channel(log)) is not None:
        notes.append(str(known))
    elif slope is not None and log.accel is not None and log.accel_cmd is None:
        late = lateness(log.elapsed, parts, slope, log.accel)
        if late is not None and late.correlation >= _AGREE and abs(late.seconds) > 0.5 / log.rate_hz:
            order = "after" if late.seconds > 0 else "before"
            notes.append(
                f"accel comes {abs(late.seconds):.2f} s {order} the slope of speed: a filter, or clocks that differ"
            )
    motion = log.accel if log.accel is not None else slope
    if motion is not None and log.accel_cmd is not None:
        late = lateness(log.elapsed, parts, log.accel_cmd, motion)
        if late is not None and late.correlation >= _AGREE and 0 <= late.seconds < WITHIN_S:
            notes.append(f"the car follows the command after {late.seconds:.2f} s, lag and dead time together")
    if (rest := _at_rest(log)) is not None and abs(rest) > _TOLD_MPS2:
        notes.append(f"accel reads {rest:.2g} m/s² while the car stands: an offset, or a slope where it stood")
    if log.accel is not None and (size := _trembling(log.accel, log.rate_hz)) > _TOLD_MPS2:
        notes.append(f"accel trembles by {size:.2g} m/s² above {_TREMBLES_HZ:g} Hz")
    return notes


def excitation_notes(log: Log) -> list[str]:
    """Sentences on what the drive can tell, and what it cannot."""
    usable = log.usable
    seconds = float(usable.sum()) / log.rate_hz
    if not usable.any():
        return ["nothing can be told: no row counts"]
    can, cannot = [], []
    if log.accel_cmd is not None:
        u = log.accel_cmd[usable]
        size, brake = float(u.std()), float((u < -0.1).mean())
        can.append(
            f"the command moves by {size:.2g} m/s² (SD) over {seconds:.0f} s that count, {brake:.0%} of it braking"
        )
        if size < 0.1:
            cannot.append("lag and gain: the command hardly moves")
        if not 0.05 < brake < 0.95:
            cannot.append("whether brake and throttle differ: one of them is hardly used")
    if log.speed is not None:
        low, high = np.quantile(log.speed[usable], (0.02, 0.98))
        can.append(f"speeds from {low:.2g} to {high:.3g} m/s")
        if high - low < 0.25 * high:
            cannot.append("what depends on speed, such as drag: speed hardly changes")
    else:
        cannot.append("what depends on speed or place: the log has no speed")
    if log.accel is None or log.speed is None:
        cannot.append("whether a sensor errs or the car: one channel alone is recorded")
    if log.accel_cmd is None and not log.pedals and log.speed_cmd is not None:
        cannot.append("the actuator's gain from the map of speed_cmd, whose scale it is")
        if np.ptp(log.speed_cmd[usable]) == 0:
            cannot.append("the controller of speed_cmd, which never moves: only wind and noise move the car")
    elif log.accel_cmd is None and log.pedals:
        cannot.append(f"the actuator's gain from the map of {' and '.join(log.pedals)}, whose scale it is")
    elif log.accel_cmd is None:
        cannot.append("the actuator's gain without assuming a controller: the log has no accel_cmd")
    if seconds < 60.0:
        cannot.append(f"small or rare effects: {seconds:.0f} s are short")
    return [*can, *(f"cannot tell {what}" for what in cannot)]


def slope_of(time: FloatArray, speed: FloatArray) -> FloatArray:
    """The slope of speed (row,) over half a second [m/s²]."""
    return (np.interp(time + 0.25, time, speed) - np.interp(time - 0.25, time, speed)) / 0.5


def _at_rest(log: Log) -> float | None:
    """What the accelerometer reads at rest [m/s²]: its median where speed is zero to the last digit for `_REST_S`."""
    if log.speed is None or log.accel is None:
        return None
    zero = np.abs(log.speed) <= (quantum(log.speed) or 0.0) / 2
    rows = [log.accel[part] for part in stretches(zero, log.segment) if part.stop - part.start > _REST_S * log.rate_hz]
    return float(np.median(np.concatenate(rows))) if rows else None


def _trembling(values: FloatArray, rate_hz: float) -> float:
    """Root mean square of what is quicker than `_TREMBLES_HZ`."""
    width = max(round(rate_hz / (2 * _TREMBLES_HZ)), 1)
    if width < 3 or len(values) < 4 * width:
        return 0.0
    smooth = np.convolve(values, np.ones(width) / width, mode="same")
    return float(np.std((values - smooth)[width:-width]))


WITHIN_S = 1.5
"""Lateness that is looked for."""
_LEAST = 50  # rows


class Lateness(NamedTuple):
    """`seconds` by which the second signal follows the first where they `correlate` best; `lead` over the correlation
    at the opposite lateness."""

    seconds: float
    correlation: float
    lead: float


def lateness(time: FloatArray, parts: list[slice], first: FloatArray, second: FloatArray) -> Lateness | None:
    """How much later `second` (row,) is than `first` (row,); None where neither moves or the rows are too few."""
    part = max(parts, key=lambda s: s.stop - s.start, default=slice(0, 0))
    t = time[part]
    if len(t) < _LEAST:
        return None
    step = float(np.median(np.diff(t)))
    grid = np.arange(t[0], t[-1], step)
    x, y = (np.interp(grid, t, signal[part]) for signal in (first, second))
    most = min(round(WITHIN_S / step), len(grid) // 4)
    if most < 2 or x.std() == 0 or y.std() == 0:
        return None
    lags = np.arange(-most, most + 1)
    middle = slice(most, len(grid) - most)
    here = x[middle] - x[middle].mean()
    found = np.array([_correlation(here, y[most + lag : len(grid) - most + lag]) for lag in lags])
    best = int(np.argmax(found))
    peak = float(lags[best])
    if 0 < best < len(lags) - 1:
        left, top, right = found[best - 1 : best + 2]
        bend = left - 2 * top + right
        peak += 0.0 if bend == 0 else float(0.5 * (left - right) / bend)
    return Lateness(peak * step, float(found[best]), float(found[best] - found[len(lags) - 1 - best]))


def _correlation(x: FloatArray, y: FloatArray) -> float:
    y = y - y.mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / size if size > 0 else 0.0
