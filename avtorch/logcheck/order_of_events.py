"""Which of two signals comes first: a response follows its command, and one channel's clock may be late."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray

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
