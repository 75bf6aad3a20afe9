"""Signals that come with their own time stamps, brought onto one clock: held, never interpolated."""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError


def held(clock: FloatArray, stamps: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The last value that had arrived at each tick of ``clock``, and its age [s].

    ``clock`` is ``(time,)``, ``stamps`` and ``values`` are ``(message,)``, stamps strictly rising; both answers are
    ``(time,)``. Before the first message there is nothing to hold: value NaN, age infinite. Interpolating instead would
    let a value act before it was measured. Raises InputError for stamps that do not rise.

    Example:
        >>> import numpy as np
        >>> from avtorch.io import held
        >>> clock, stamps, commands = np.array([0.0, 0.1, 0.2]), np.array([0.05, 0.18]), np.array([1.0, 2.0])
        >>> value, age = held(clock, stamps, commands)
        >>> value.tolist(), age.round(2).tolist()
        ([nan, 1.0, 2.0], [inf, 0.05, 0.02])
    """
    if len(stamps) != len(values):
        raise InputError(f"stamps: {len(stamps)} of them for {len(values)} values; one each is needed")
    if len(stamps) == 0:
        raise InputError("stamps: none given; a signal needs at least one value")
    if np.any(np.diff(stamps) <= 0):
        message = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise InputError(
            f"stamps: message {message + 1} has {stamps[message]:g} s after {stamps[message - 1]:g} s; they must rise"
        )
    last = np.searchsorted(stamps, clock, side="right") - 1
    known = last >= 0
    at = np.maximum(last, 0)
    return np.where(known, values[at], np.nan), np.where(known, clock - stamps[at], np.inf)
