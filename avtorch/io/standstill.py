"""Where a car stands, estimated from a log without speed.

A stop is detected in two ways: a brake command without a response, held for longer than any car takes to respond; and a
deceleration that ends at once while the brake stays on, faster than any actuator releases. From the stop the
acceleration is integrated in both directions, with the reading at rest taken as zero, up to the speed at which GLVD
holds again. A car that decelerates on the way was not standing. A stop with hardly any braking is not detected.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from avtorch.arrays import BoolArray, FloatArray

_BRAKED_MPS2 = -0.5  # stronger than any dead band or a hill of 5 %
_RESTS = 0.15  # largest share of the demand that is still measured
_SLOWEST_S = 2.0  # upper bound on any car's dead time and lag
_FELT_S = 0.3  # averaging time of a reading
_REST_S = 0.5
_SLOWED_MPS2 = -0.25  # a deceleration larger than noise
_STILL_BRAKED_MPS2 = -0.3
# A deceleration that ends by a stop: the brake was not eased for longer than a car takes to respond.
_SINCE_S = 1.8
_EASED_MPS2 = 0.2


def standing(accel_cmd: FloatArray, accel: FloatArray, dt: float, below: float) -> BoolArray:
    """Rows (time,) of one drive, `dt` [s] apart, in which the car is slower than `below` [m/s].

    `accel_cmd`, `accel` (time,) [m/s²].
    """
    out = np.zeros(len(accel), bool)
    core = _braked_at_rest(accel_cmd, accel, dt) | _halted(accel_cmd, accel, dt)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], core.astype(int), [0]])))
    begins, ends = edges[::2].tolist(), edges[1::2].tolist()
    felt = _felt(accel, dt)
    for before, begin, end, after in zip([0, *ends], begins, ends, [*begins[1:], len(accel)], strict=False):
        rest = float(accel[begin:end].mean())
        last = end + _slow(accel[end:after] - rest, dt, below)
        if (felt[end:last] < rest + _SLOWED_MPS2).any():
            continue
        out[begin - _slow(rest - accel[before:begin][::-1], dt, below) : last] = True
    return out


def _braked_at_rest(accel_cmd: FloatArray, accel: FloatArray, dt: float) -> BoolArray:
    """Rows braked for longer than the slowest car takes to respond, and without deceleration."""
    brakes = accel_cmd < _BRAKED_MPS2
    rows = np.arange(len(brakes))
    braked = rows - np.maximum.accumulate(np.where(brakes, -1, rows))
    # the weakest demand to which the car may still be responding
    asked = _latest_max(np.where(brakes, accel_cmd, -np.inf), _count(_SLOWEST_S, dt))
    rests = (braked > _SLOWEST_S / dt) & (np.abs(_felt(accel, dt)) < -_RESTS * asked)
    return minimum_filter1d(rests, _count(_REST_S, dt), mode="nearest").astype(bool)


def _halted(accel_cmd: FloatArray, accel: FloatArray, dt: float) -> BoolArray:
    """The `_FELT_S` after a deceleration ended from one row to the next but one, the brake on and not eased."""
    n, rows = _count(_FELT_S, dt), len(accel)
    if rows < 2 * n + 3:
        return np.zeros(rows, bool)
    # means of the rows before each row, and of those that begin two rows later
    sums = np.concatenate([[0.0], np.cumsum(accel)])
    at = np.arange(n, rows - n - 1)
    slowed, rests = (sums[at] - sums[at - n]) / n, (sums[at + 1 + n] - sums[at + 1]) / n
    short = max(n // 3, 1)
    late = (sums[at] - sums[at - short]) / short  # the deceleration lasts into the final third
    early = (sums[at + 1 + short] - sums[at + 1]) / short
    since = _count(0.5 * _SINCE_S, dt)  # half of the time each for the search of the minimum and of the rise after it
    eased = _latest_max(accel_cmd + _latest_max(-accel_cmd, since), since) > _EASED_MPS2
    ends = (slowed < _SLOWED_MPS2) & (late < 0.7 * slowed) & (early > 0.4 * slowed) & (np.abs(rests) < -0.25 * slowed)
    found = np.zeros(rows, bool)
    found[at + 1] = ends & ~eased[at + n] & (_latest_max(accel_cmd, n)[at + n] < _STILL_BRAKED_MPS2)
    return _latest_max(found.astype(float), n - 1) > 0


def _felt(accel: FloatArray, dt: float) -> FloatArray:
    return np.asarray(uniform_filter1d(accel, _count(_FELT_S, dt), mode="nearest"))


def _count(seconds: float, dt: float) -> int:
    return max(round(seconds / dt), 1)


def _latest_max(x: FloatArray, width: int) -> FloatArray:
    """The largest of each row and the `width` rows before it."""
    padded = np.concatenate([np.full(2 * width + 1, -np.inf), x])
    return np.asarray(maximum_filter1d(padded, width + 1, origin=width // 2)[2 * width + 1 :])


def _slow(accel: FloatArray, dt: float, below: float) -> int:
    """Rows until a car at rest, which never rolls back, is at `below`."""
    gained = np.cumsum(accel) * dt
    speed = gained - np.minimum(np.minimum.accumulate(gained), 0.0)
    fast = speed >= below
    return int(np.argmax(fast)) if fast.any() else len(accel)
