"""The noise's free spectrum: an autoregression of each channel, by which residuals become white.

Plant and noise share no parameters (Box and Jenkins): whatever colour vibration, filters, quantisation and holds give
the noise, a long autoregression takes it. It is fitted once, to what a flexible regression on commands, speed and time
leaves over, and is the same for all models. Fitted to the residuals of a model that lacks an effect it would take the
effect for slow noise: of 214 nats for a resistance on a real car that left one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import firwin

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.analysis_record import AnalysisRecord

_MEMORY_S = 1.0  # of the autoregression
_BAND_HZ = 1.0  # of the first guess: noise is flat below and without bound above
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class NoiseWhitening:
    """Filters `taps` (channel, lag) and the SD of what they leave `sd` (channel,) [m/s²], for one record.

    `order` (counted,) are the rows that count once the filter has its past, sorted by block; `first` (block,) is where
    each block begins in it.
    """

    record: AnalysisRecord
    taps: FloatArray
    sd: FloatArray
    order: IntArray
    first: IntArray

    @classmethod
    def of(cls, record: AnalysisRecord, taps: FloatArray, sd: FloatArray) -> NoiseWhitening:
        counts = record.counts.copy()
        for stretch in record.stretches:
            lost = np.concatenate([np.ones(taps.shape[1] - 1), ~record.counts[stretch.rows]])
            counts[stretch.rows] = np.convolve(lost, np.ones(taps.shape[1]), "valid") == 0
        rows = np.nonzero(counts)[0]
        order = rows[np.argsort(record.block[rows], kind="stable")]
        first = np.unique(record.block[order], return_index=True)[1]
        return cls(record, taps, sd, order, first)

    @classmethod
    def band(cls, record: AnalysisRecord, residuals: FloatArray) -> NoiseWhitening:
        """The first guess: only what lies below 1 Hz counts; its size from `residuals` (channel, row)."""
        lags = 2 * round(0.4 / record.dt) + 1
        taps = np.tile(firwin(lags, min(_BAND_HZ, 0.45 / record.dt), fs=1 / record.dt), (len(record.channels), 1))
        guess = cls.of(record, taps, np.ones(len(taps)))
        return cls.of(record, taps, guess(residuals).std(-1) + 1e-9)

    @classmethod
    def autoregressive(cls, record: AnalysisRecord, residuals: FloatArray) -> NoiseWhitening:
        """By Yule and Walker, from `residuals` (channel, row)."""
        lags = max(4, round(_MEMORY_S / record.dt))
        taps, sds = [], []
        for channel in residuals:
            covariance, rows = np.zeros(lags + 1), 0
            for stretch in record.stretches:
                x = np.where(record.counts[stretch.rows], channel[stretch.rows], 0.0)
                spectrum = np.abs(np.fft.rfft(x, 2 * len(x))) ** 2
                lagged = np.fft.irfft(spectrum)[: lags + 1]
                covariance[: len(lagged)] += lagged
                rows += int(record.counts[stretch.rows].sum())
            covariance /= rows
            covariance[0] = covariance[0] * (1 + _RIDGE) + 1e-12
            a = solve_toeplitz(covariance[:lags], covariance[1:])
            taps.append(np.concatenate([[1.0], -a]))
            sds.append(np.sqrt(max(covariance[0] - a @ covariance[1:], 1e-12)))
        return cls.of(record, np.array(taps), np.array(sds))

    @property
    def blocks(self) -> int:
        return len(self.first)

    @property
    def numbers(self) -> IntArray:
        """The record's numbers (block,) of these blocks; one whose rows are all the filter's past has none here."""
        return self.record.block[self.order[self.first]]

    @property
    def lengths(self) -> IntArray:
        """Rows (block,) that count."""
        return np.diff(np.append(self.first, len(self.order)))

    def __call__(self, x: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) of `x` (..., channel, row), in units of their SD, sorted by block."""
        out = np.empty((*x.shape[:-1], len(self.order)))
        for c, (taps, sd) in enumerate(zip(self.taps, self.sd, strict=True)):
            out[..., c, :] = self.record.filtered(x[..., c, :], taps)[..., self.order] / sd
        return out

    def by_block(self, squares: FloatArray) -> FloatArray:
        """Sums (..., block) of `squares` (..., channel, counted)."""
        return np.add.reduceat(squares.sum(-2), self.first, axis=-1)

    def spread(self, weights: FloatArray) -> FloatArray:
        """Weights (block,) as (counted,)."""
        return np.repeat(weights, self.lengths)
