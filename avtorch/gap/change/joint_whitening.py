"""White residuals of both channels together: what shakes the car shows in both, and is counted once.

A force of chance (wind, road) is in the accelerometer and in the derivative of speed alike. A filter of each channel by
itself takes that for two independent noises; a fault of the accelerometer, which shows in their difference, then looks
as uncertain as the force. A vector autoregression knows the difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.noise_whitening import NoiseWhitening

_MEMORY_S = 1.0
_RIDGE = 1e-6


@dataclass(frozen=True, eq=False)
class JointWhitening(NoiseWhitening):
    """As `NoiseWhitening`, with filters `mixed` (channel, channel, lag); `taps` only says how long they are."""

    mixed: FloatArray = None  # type: ignore[assignment]

    @classmethod
    def vector_autoregressive(cls, record: AnalysisRecord, residuals: FloatArray) -> JointWhitening:
        """Yule and Walker's, of `residuals` (channel, row) [m/s²] in all channels at once."""
        lags, channels = max(4, round(_MEMORY_S / record.dt)), len(residuals)
        lagged = _covariances(record, residuals, lags)
        blocks = [[lagged[m - k] if m >= k else lagged[k - m].T for m in range(lags)] for k in range(lags)]
        predicted = np.concatenate(list(lagged[1:]), 1)
        coefficients = np.linalg.solve(np.block(blocks).T, predicted.T).T  # (channel, lag · channel)
        innovation = lagged[0] - coefficients @ predicted.T
        root = np.linalg.inv(np.linalg.cholesky(0.5 * (innovation + innovation.T)))
        each = coefficients.reshape(channels, lags, channels).transpose(0, 2, 1)
        mixed = np.concatenate([np.eye(channels)[..., None], -each], -1)
        mixed = np.einsum("ij,jkl->ikl", root, mixed)
        plain = NoiseWhitening.of(record, mixed[:, 0], np.ones(channels))
        return cls(record, plain.taps, plain.sd, plain.order, plain.first, mixed=mixed)

    def __call__(self, x: FloatArray) -> FloatArray:
        """White residuals (..., channel, counted) of `x` (..., channel, row), of unit variance, sorted by block."""
        out = np.zeros((*x.shape[:-1], len(self.order)))
        for i, row in enumerate(self.mixed):
            for j, taps in enumerate(row):
                out[..., i, :] += self.record.filtered(x[..., j, :], taps)[..., self.order]
        return out


def _covariances(record: AnalysisRecord, residuals: FloatArray, lags: int) -> FloatArray:
    """E[x_t x_(t-k)'], (lag, channel, channel), over the rows that count."""
    channels = len(residuals)
    out = np.zeros((lags + 1, channels, channels))
    for stretch in record.stretches:
        x = np.where(record.counts[stretch.rows], residuals[:, stretch.rows], 0.0)
        spectra = np.fft.rfft(x, 2 * x.shape[-1])
        lagged = np.fft.irfft(spectra[:, None] * spectra[None].conj())[..., : lags + 1]
        out[: lagged.shape[-1]] += np.moveaxis(lagged, -1, 0)
    out /= record.counts.sum()
    out[0] += _RIDGE * np.diag(np.diag(out[0])) + 1e-12 * np.eye(channels)
    return out
