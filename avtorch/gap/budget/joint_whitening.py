"""White residuals of both channels together: what shakes the car shows in both, and is counted once.

A force of chance (wind, road) is in the accelerometer and in the derivative of speed alike. A filter of each channel by
itself takes that for two independent noises; a fault of the accelerometer, which shows in their difference, then looks
as uncertain as the force. A vector autoregression knows the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import MEMORY_S, AnalysisRecord
from avtorch.gap.budget.noise_whitening import NoiseWhitening, calm, pieces

_RIDGE = 1e-6
_TWO_SIGNALS = -1.0  # log of what knowing both channels leaves of their innovations' variances
# simulated drives behind either recorder, and recordings with an accelerometer: -0.03 to -0.73; acceleration computed
# from the speed, 21 drives each: -1.3 to -2.7 by a fit over eleven rows, -2.2 to -3.0 behind a low-pass of 0.3 s, -5.1
# to -6.9 from row to row


@dataclass(frozen=True, eq=False)
class JointWhitening(NoiseWhitening):
    """As `NoiseWhitening`, with filters `mixed` (channel, channel, lag); `taps` only says how long they are.

    `together`: log of the innovations' determinant, over that of each channel by itself.
    """

    mixed: FloatArray = None  # type: ignore[assignment]
    together: float = 0.0

    @property
    def one_signal(self) -> bool:
        """Whether the channels are not measured apart: an acceleration that was computed from the speed.

        Their difference then has hardly any noise, and is not the car's but that of how it was computed.
        """
        return self.together < _TWO_SIGNALS

    @classmethod
    def vector_autoregressive(
        cls, record: AnalysisRecord, residuals: FloatArray, *, level_s: float | None = None
    ) -> JointWhitening:
        """Yule and Walker's, of `residuals` (channel, row) [m/s²] in all channels at once.

        `level_s`: time [s] over which a level is no noise, the wildest such pieces left out; None: all is noise.
        """
        lags, channels = max(4, round(MEMORY_S / record.dt)), len(residuals)
        lagged = _covariances(record, residuals, lags, level_s)
        blocks = [[lagged[m - k] if m >= k else lagged[k - m].T for m in range(lags)] for k in range(lags)]
        predicted = np.concatenate(list(lagged[1:]), 1)
        coefficients = np.linalg.solve(np.block(blocks).T, predicted.T).T  # (channel, lag · channel)
        innovation = lagged[0] - coefficients @ predicted.T
        root = np.linalg.inv(np.linalg.cholesky(0.5 * (innovation + innovation.T)))
        each = coefficients.reshape(channels, lags, channels).transpose(0, 2, 1)
        mixed = np.concatenate([np.eye(channels)[..., None], -each], -1)
        mixed = np.einsum("ij,jkl->ikl", root, mixed)
        plain = NoiseWhitening.of(record, mixed[:, 0], np.ones(channels))
        together = float(np.linalg.slogdet(innovation)[1] - np.log(_innovations(lagged)).sum())
        return cls(record, plain.taps, plain.sd, plain.order, plain.first, mixed=mixed, together=together)

    def __call__(self, x: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) of `x` (..., channel, row), of unit variance, sorted by block."""
        out = np.zeros((*x.shape[:-1], len(self.order)))
        for i, row in enumerate(self.mixed):
            for j, taps in enumerate(row):
                out[..., i, :] += self.record.filtered(x[..., j, :], taps)[..., self.order]
        return out

    def since(self, x: FloatArray) -> FloatArray:
        """As a call, of consecutive rows `x` (..., channel, row) of a stretch before which all is zero."""
        out = np.zeros_like(x)
        for i, row in enumerate(self.mixed):
            for j, taps in enumerate(row):
                out[..., i, :] += lfilter(taps, [1.0], x[..., j, :])
        return out


def of_both_channels(record: AnalysisRecord, residuals: FloatArray, *, level_s: float | None = None) -> NoiseWhitening:
    """White residuals of both together, or of each by itself where they are one signal, which then counts once."""
    joint = JointWhitening.vector_autoregressive(record, residuals, level_s=level_s)
    if not joint.one_signal:
        return joint
    apart = NoiseWhitening.autoregressive(record, residuals)
    return replace(apart, share=apart.share / len(record.channels))


def _innovations(lagged: FloatArray) -> FloatArray:
    """The variance (channel,) that each channel's own past leaves, of covariances (lag, channel, channel)."""
    own = np.diagonal(lagged, axis1=1, axis2=2).T
    return np.array([x[0] - x[1:] @ solve_toeplitz(x[:-1], x[1:]) for x in own])


def _covariances(record: AnalysisRecord, residuals: FloatArray, lags: int, level_s: float | None) -> FloatArray:
    """E[x_t x_(t-k)'], (lag, channel, channel), over the rows that count."""
    sums, rows = [], []
    for piece in pieces(record, level_s):
        own, x = record.counts[piece], residuals[:, piece]
        x = np.where(own, x if level_s is None else x - x[:, own].mean(-1, keepdims=True), 0.0)
        spectra = np.fft.rfft(x, x.shape[-1] + lags)
        lagged = np.fft.irfft(spectra[:, None] * spectra[None].conj(), x.shape[-1] + lags)[..., : lags + 1]
        sums.append(np.moveaxis(lagged, -1, 0))
        rows.append(int(own.sum()))
    covariances, counted = np.array(sums), np.array(rows)
    size = np.diagonal(covariances[:, 0], axis1=1, axis2=2) / counted[:, None]
    kept = np.arange(len(counted)) if level_s is None else calm(size / size.mean(0))
    out = covariances[kept].sum(0) / counted[kept].sum()
    out[0] += _RIDGE * np.diag(np.diag(out[0])) + 1e-12 * np.eye(len(residuals))
    return out
