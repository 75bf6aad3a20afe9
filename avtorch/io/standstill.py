"""Where a car stands, told by a log that has no speed: braked, yet not slowing.

A stop shows itself by a brake command, held for longer than any car takes to answer, to which nothing more happens.
From there the acceleration is integrated both ways, its reading at rest taken as zero, up to the speed at which GLVD
holds again. A stop that asks for less braking than `_BRAKED_MPS2`, or one shorter than a second, is not seen.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

Float = NDArray[np.float64]

_BRAKED_MPS2 = -0.5  # more than a dead band hides or a hill of 5 % takes
_ANSWERED = 0.15  # of the command, by the weakest of cars
_SLOWEST_S = 2.0  # dead time and lag of a car slower than any
_LATEST_S = 0.9  # dead time alone
_FELT_S = 0.3
_REST_S = 0.5


def standing(accel_cmd: Float, accel: Float, dt: float, below: float) -> NDArray[np.bool_]:
    """Rows (time,) of one drive, `dt` [s] apart, in which the car is slower than `below` [m/s].

    `accel_cmd`, `accel` (time,) [m/s²].
    """
    core = _braked_at_rest(accel_cmd, accel, dt)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], core.astype(int), [0]])))
    begins, ends = edges[::2], edges[1::2]
    out = core.copy()
    for i, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
        rest = float(accel[begin:end].mean())
        before = slice(0 if i == 0 else int(ends[i - 1]), begin)
        after = slice(end, len(accel) if i + 1 == len(begins) else int(begins[i + 1]))
        stays = _slow(accel[after] - rest, dt, below)
        out[end : end + stays] = True
        stays = _slow(rest - accel[before][::-1], dt, below)
        out[begin - stays : begin] = True
    return out


def _braked_at_rest(accel_cmd: Float, accel: Float, dt: float) -> NDArray[np.bool_]:
    """Braked for longer than the slowest car takes to answer; or braked, answered, and at rest again all the same."""
    brakes = accel_cmd < _BRAKED_MPS2
    rows = np.arange(len(brakes))
    braked = rows - np.maximum.accumulate(np.where(brakes, -1, rows))  # rows since the brake is on
    felt = uniform_filter1d(accel, max(round(_FELT_S / dt), 1), mode="nearest")
    # the weakest demand that the car may still be answering to
    asked = _trailing_max(np.where(brakes, accel_cmd, -np.inf), round(_SLOWEST_S / dt))
    answers = (braked > _LATEST_S / dt) & (felt < 0.4 * asked)
    answered = rows - np.maximum.accumulate(np.where(answers, rows, -len(rows))) < braked
    rests = brakes & (np.abs(felt) < -_ANSWERED * asked) & ((braked > _SLOWEST_S / dt) | answered)
    return minimum_filter1d(rests, max(round(_REST_S / dt), 1), mode="nearest").astype(bool)


def _trailing_max(x: Float, width: int) -> Float:
    """The largest of each row and the `width` rows before it."""
    padded = np.concatenate([np.full(2 * width, -np.inf), x])
    return np.asarray(maximum_filter1d(padded, width + 1, origin=width // 2)[2 * width :])


def _slow(accel: Float, dt: float, below: float) -> int:
    """Rows until a car at rest, which never rolls back, is at `below`."""
    gained = np.cumsum(accel) * dt
    speed = gained - np.minimum(np.minimum.accumulate(gained), 0.0)
    fast = speed >= below
    return int(np.argmax(fast)) if fast.any() else len(accel)
