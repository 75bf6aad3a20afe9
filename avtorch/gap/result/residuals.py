"""What is left of the gap: residuals of the rollouts against command, speed, time, frequency and earlier commands.

Bands say how far chance alone would go: means of bins by the spread between blocks of the drive, the spectrum by the
chi-square law of its average, the correlation with earlier commands by Bartlett's formula for two independent coloured
signals (Box, Jenkins and Reinsel, Time Series Analysis, 4th ed., 2008, Sec. 12.1), as in the residual test of system
identification (Ljung, System Identification, 2nd ed., 1999, Sec. 16.6).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.signal import correlate, welch
from scipy.special import chdtri, stdtrit

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.result.traces import Traces

BLOCK_S = 10.0
"""Length of the blocks whose spread gives a bin's interval [s]."""
_SLOPE_S = 1.0  # over which a speed error is turned into an acceleration error
_SEGMENT_S = 20.0  # of the averaged spectra
_COLOUR_S = 30.0  # up to which signals are correlated with themselves
_LAGS_S = (-1.0, 5.0)
_LEAST_BLOCKS = 4  # in a bin that has an interval
_Z99 = 2.5758293035489004
_OVERLAPPED = 1.89  # degrees of freedom per segment: Hann windows that overlap by half (Welch, 1967)


def residuals(traces: Traces) -> tuple[FloatArray, FloatArray]:
    """Residuals (row,) [m/s²] of the simulator before and after the repair: measured less simulated.

    Of the acceleration where it was measured; else of the speed's slope over 1 s, as a rollout's speed itself drifts.
    """
    measured, before, after = traces.accelerations(_SLOPE_S)
    return measured - before, measured - after


def binned_means(traces: Traces, axis: FloatArray, residual: FloatArray, *, bins: int = 9) -> BinnedMeans:
    """Means of `residual` (row,) in bins of `axis` (row,) that hold as many rows each."""
    edges = np.unique(np.quantile(axis, np.linspace(0, 1, bins + 1)))
    number = np.searchsorted(edges[1:-1], axis, side="right")
    block = _blocks(traces)
    many = max(int(number.max(initial=0)) + 1, 1)
    counts, sums, along = (np.zeros((int(block.max(initial=0)) + 1, many)) for _ in range(3))
    for array, values in ((counts, np.ones_like(axis)), (sums, residual), (along, axis)):
        np.add.at(array, (block, number), values)
    total = counts.sum(0)
    mean = sums.sum(0) / total
    blocks = (counts > 0).sum(0)
    # a ratio of sums over blocks, whose errors are those of independent blocks
    spread = np.sqrt(((sums - mean * counts) ** 2).sum(0) * blocks / np.maximum(blocks - 1, 1)) / total
    half = np.where(blocks >= _LEAST_BLOCKS, stdtrit(np.maximum(blocks - 1, 1), 0.95) * spread, np.nan)
    return BinnedMeans(along.sum(0) / total, mean, mean - half, mean + half)


def spectrum(traces: Traces, residual: FloatArray) -> Spectrum | None:
    """Power of `residual` (row,) over frequency; None where no stretch is long enough."""
    size = max(8, round(_SEGMENT_S / traces.step))
    count, total, frequency = 0, np.zeros(size // 2 + 1), np.zeros(0)
    for rows in traces.stretches:
        if parts := (len(rows) - size) // (size // 2) + 1 if len(rows) >= size else 0:
            frequency, power = welch(residual[rows], 1 / traces.step, nperseg=size, noverlap=size - size // 2)
            count, total = count + parts, total + parts * power
    if not count:
        return None
    mean = total[1:] / count
    freedom = max(2.0, _OVERLAPPED * count)
    low, high = (freedom / chdtri(freedom, p) for p in (0.05, 0.95))
    return Spectrum(frequency[1:], mean, mean * low, mean * high)


def correlation(traces: Traces, residual: FloatArray) -> Correlation:
    """Of `residual` (row,) with the command a lag earlier, from -1 s (a later command) to 5 s."""
    first, last = (round(lag / traces.step) for lag in _LAGS_S)
    parts = traces.stretches
    u, e = traces.command - traces.command.mean(), residual - residual.mean()
    scale = np.sqrt((u**2).sum() * (e**2).sum()) or 1.0
    both = _products(u, e, parts, first, last) / scale
    reach = min(round(_COLOUR_S / traces.step), max(map(len, parts), default=1) - 1)
    own = [_products(x, x, parts, 0, reach) / ((x**2).sum() or 1.0) for x in (u, e)]
    together = own[0] * own[1]
    # independent coloured signals vary like fewer white rows
    variance = max(float(together[0] + 2 * together[1:].sum()), 1.0) / len(e)
    return Correlation(
        np.linspace(first * traces.step, last * traces.step, last - first + 1), both, _Z99 * variance**0.5
    )


def usual(residual: FloatArray) -> float:
    """Within ± this [m/s²] would lie 99 % of a steady normal `residual` (row,) with these quartiles."""
    low, high = np.quantile(residual, (0.25, 0.75))
    return float(_Z99 * (high - low) / (2 * 0.6744897501960817))


def _blocks(traces: Traces) -> IntArray:
    """The number of each row's block."""
    size = max(1, round(BLOCK_S / traces.step))
    numbers, first = [], 0
    for rows in traces.stretches:
        numbers.append(first + np.arange(len(rows)) // size)
        first = int(numbers[-1][-1]) + 1 if len(rows) else first
    return np.concatenate(numbers)


def _products(u: FloatArray, e: FloatArray, parts: list[IntArray], least: int, most: int) -> FloatArray:
    """Sums over the stretches of `u`, a lag earlier, times `e`, for every lag [rows] from `least` to `most`."""
    total = np.zeros(most - least + 1)
    for rows in parts:
        size = len(rows)
        both = correlate(e[rows], u[rows], method="fft")  # lags -(size - 1) to size - 1
        lags = np.arange(max(least, 1 - size), min(most, size - 1) + 1)
        total[lags - least] += both[lags + size - 1]
    return total


class BinnedMeans(NamedTuple):
    """Bins (bin,): their mean place, the residual's mean [m/s²] and its central 90 %, NaN where blocks are too few."""

    place: FloatArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray


class Spectrum(NamedTuple):
    """Power density [(m/s²)²/Hz] over `frequency` [Hz], each (frequency,), with its central 90 %."""

    frequency: FloatArray
    power: FloatArray
    low: FloatArray
    high: FloatArray


class Correlation(NamedTuple):
    """Correlation (lag,) [-] over `lag` [s]; within ± `band` lie 99 % where the two signals are independent."""

    lag: FloatArray
    value: FloatArray
    band: float
