"""The noise's free spectrum: an autoregression of each channel, by which residuals become white.

Plant and noise share no parameters (Box and Jenkins): whatever colour vibration, filters, quantisation and holds give
the noise, a long autoregression takes it. It is fitted once, to what a flexible regression on commands, speed and time
leaves over, and is the same for all models. Fitted to the residuals of a model that lacks an effect it would take the
effect for slow noise: of 214 nats for a resistance on a real car that left one.

Only a causal whitening of the whole band will do, as most drives are closed loops: a command that follows the measured
speed holds the noise of the rows before it. White residuals of the whole band know nothing of commands that came
before them, and a wrong model cannot gain by that (Ljung, direct identification). Behind a low-pass they do: with one
of 2.5 Hz, cars that follow another were given dead times of 0.2 s that they do not have, with up to 150 nats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import firwin, lfilter

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.analysis_record import MEMORY_S, AnalysisRecord

LEVEL_S = 60.0
"""Seconds over which a level is no noise."""
_WILDEST = 0.15  # of the pieces of that length, which do not count
_GUESSED_HZ = 1.0  # band of the first guess, in which noise is flat
_LOWPASS_PERIODS = 1.0  # of the band's edge, that its filter lasts
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class NoiseWhitening:
    """Filters `taps` (channel, lag) and the SD of what they leave `sd` (channel,) [m/s²], for one record.

    `order` (counted,) are the rows that count once the filter has its past, sorted by block; `first` (block,) is where
    each block begins in it. `share`: of a row, that it counts as: rows of a narrow band repeat each other.
    """

    record: AnalysisRecord
    taps: FloatArray
    sd: FloatArray
    order: IntArray
    first: IntArray
    share: float = 1.0

    @classmethod
    def of(cls, record: AnalysisRecord, taps: FloatArray, sd: FloatArray, share: float = 1.0) -> NoiseWhitening:
        rows = np.nonzero(record.with_past(taps.shape[1] - 1))[0]
        order = rows[np.argsort(record.block[rows], kind="stable")]
        first = np.unique(record.block[order], return_index=True)[1]
        return cls(record, taps, sd, order, first, share)

    @classmethod
    def band(cls, record: AnalysisRecord, residuals: FloatArray) -> NoiseWhitening:
        """The first guess: only what lies below 1 Hz counts; its size from `residuals` (channel, row)."""
        lowpass = _lowpass(_GUESSED_HZ, record.dt)
        return cls._sized(record, np.tile(lowpass, (len(record.channels), 1)), residuals, _GUESSED_HZ)

    @classmethod
    def autoregressive(cls, record: AnalysisRecord, residuals: FloatArray) -> NoiseWhitening:
        """By Yule and Walker, from `residuals` (channel, row)."""
        lags = max(4, round(MEMORY_S / record.dt))
        taps = []
        for channel in residuals:
            covariance = _covariance(record, channel, lags)
            covariance[0] = covariance[0] * (1 + _RIDGE) + 1e-12
            a = solve_toeplitz(covariance[:lags], covariance[1:])
            taps.append(np.concatenate([[1.0], -a]))
        return cls._sized(record, np.array(taps), residuals, 0.5 / record.dt)

    @classmethod
    def _sized(cls, record: AnalysisRecord, taps: FloatArray, residuals: FloatArray, band_hz: float) -> NoiseWhitening:
        """With the SD that `taps` leave of `residuals`."""
        plain = cls.of(record, taps, np.ones(len(taps)))
        return cls.of(record, taps, plain(residuals).std(-1) + 1e-9, min(1.0, 2 * band_hz * record.dt))

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
        """White residuals (..., channel, counted) of `x` (..., channel, row), sorted by block.

        In units of their SD, as far as a row counts: the sum of squares is the number of values that say something new.
        """
        out = np.empty((*x.shape[:-1], len(self.order)))
        for c, (taps, sd) in enumerate(zip(self.taps, self.sd / np.sqrt(self.share), strict=True)):
            out[..., c, :] = np.take(self.record.filtered(x[..., c, :], taps / sd), self.order, axis=-1)
        return out

    def since(self, x: FloatArray) -> FloatArray:
        """As a call, of consecutive rows `x` (..., channel, row) of a stretch before which all is zero."""
        out = [
            lfilter(taps, [1.0], x[..., c, :]) / sd for c, (taps, sd) in enumerate(zip(self.taps, self.sd, strict=True))
        ]
        return np.stack(out, -2) * np.sqrt(self.share)

    def by_block(self, squares: FloatArray) -> FloatArray:
        """Sums (..., block) of `squares` (..., channel, counted)."""
        return np.add.reduceat(squares.sum(-2), self.first, axis=-1)

    def spread(self, weights: FloatArray) -> FloatArray:
        """Weights (block,) as (counted,)."""
        return np.repeat(weights, self.lengths)


def _covariance(record: AnalysisRecord, x: FloatArray, lags: int) -> FloatArray:
    """Of `x` (row,) with itself, (lag,), each piece of about a minute about its own mean, without the wildest of them.

    A bias that sets in would otherwise make every level look like one that wanders, and hide itself. Much shorter
    pieces would take from the noise what wanders in a few seconds, and loops feed that back.
    """
    sums, counted = [], []
    for piece in pieces(record, LEVEL_S):
        own = record.counts[piece]
        moved = np.where(own, x[piece] - x[piece][own].mean(), 0.0)
        spectrum = np.abs(np.fft.rfft(moved, len(piece) + lags)) ** 2
        sums.append(np.fft.irfft(spectrum, len(piece) + lags)[: lags + 1])
        counted.append(int(own.sum()))
    covariances, rows = np.array(sums), np.array(counted)
    kept = calm(covariances[:, :1] / rows[:, None])
    return covariances[kept].sum(0) / rows[kept].sum()


def pieces(record: AnalysisRecord, seconds: float | None) -> list[IntArray]:
    """Rows of each stretch, in pieces of about `seconds` (None: whole), those without a row that counts left out."""
    found = []
    for stretch in record.stretches:
        whole = np.arange(stretch.rows.start, stretch.rows.stop)
        count = 1 if seconds is None else max(1, round(len(whole) * record.dt / seconds))
        found += [piece for piece in np.array_split(whole, count) if record.counts[piece].any()]
    return found


def calm(variance: FloatArray) -> IntArray:
    """The pieces without the wildest, by their `variance` (piece, channel) summed over channels."""
    return np.argsort(variance.sum(-1))[: max(1, round((1 - _WILDEST) * len(variance)))]


def _lowpass(band_hz: float, dt: float) -> FloatArray:
    """Taps (lag,) of a filter that passes what is below `band_hz`, all of it where rows hold no more."""
    if band_hz >= 0.45 / dt:
        return np.ones(1)
    lags = 2 * round(0.5 * _LOWPASS_PERIODS / band_hz / dt) + 1
    return np.asarray(firwin(lags, band_hz, fs=1 / dt), dtype=float)
