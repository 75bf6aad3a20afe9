"""The likelihood of residuals whose noise has any spectrum: its covariance is integrated out, band by band.

In band b with n_b coefficients a channel, covariance free, Jeffreys' prior:

    log L = -1/2 sum_b n_b log det E_b,   E_b = 1/n_b sum R R'        (a multivariate Student; Gelman et al. 2013, 3.6)

There is no fit of the noise: each hypothesis has its own spectrum, and removing a slow error of few coefficients gains
only logarithmically. A fit looks at all bands, and no hypothesis gains more than in those below 10 Hz (`claimed`): in a
closed loop the command answers the noise, and the cross terms cancel over all frequencies only (prediction-error
identification; Ljung 1999, 13).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
LEAST = 1e-9
"""Of a covariance's trace: what no channel's rounding goes below."""


def band_covariance(data: DriveData, residual: FloatArray) -> FloatArray:
    """Mean products of the channels' residuals (channel, frame, bin) in each band: (band, channel, channel)."""
    C = data.channel_count
    out = np.empty((data.band_count, C, C))
    for i in range(C):
        for j in range(i + 1):
            products = np.einsum("fk,fk->k", residual[i], residual[j])
            out[:, i, j] = out[:, j, i] = np.add.reduceat(products, data.band_edges[:-1])
    return out / data.band_size[:, None, None]


def log_likelihood(data: DriveData, residual: FloatArray, spread: FloatArray | None = None) -> tuple[float, FloatArray]:
    """Log likelihood of all bands [nats], the noise's covariance integrated out, up to a constant; and where that
    covariance (band, channel, channel) is likeliest.

    `spread` (band, channel, channel): mean square of what coefficients that are integrated out may still be wrong by in
    the residual; restricted maximum likelihood (Harville 1977) adds it to the noise, so that many coefficients cannot
    fit a band of few to nothing.
    """
    S = band_covariance(data, residual)
    S = S if spread is None else S + spread
    S = S + least_noise(S)
    return float(-0.5 * (data.band_size * np.linalg.slogdet(S)[1]).sum()), S


def least_noise(covariance: FloatArray) -> FloatArray:
    """What rounding adds to a covariance (band, channel, channel)."""
    trace = np.trace(covariance, axis1=1, axis2=2)
    return LEAST * trace[:, None, None] * np.eye(covariance.shape[-1])


def freedom(data: DriveData, covariance: FloatArray, spread: FloatArray) -> float:
    """Effective number of the coefficients that leave a `spread` under the noise's covariance: what a likelihood at its
    maximum is short of the integral over them, twice, in nats."""
    return float((data.band_size * np.einsum("bij,bji->b", np.linalg.inv(covariance), spread)).sum())


def claimed(data: DriveData, covariance: FloatArray, fmax: float | None = None) -> float:
    """Nats of the bands that begin below `fmax` [Hz], by default `claim_hz`, in which cars move."""
    n = claim_bands(data, fmax)
    return float(-0.5 * (data.band_size[:n] * np.linalg.slogdet(covariance[:n])[1]).sum())


def claim_bands(data: DriveData, fmax: float | None = None) -> int:
    """Number of bands that begin below `fmax` [Hz], by default `claim_hz`, at least one."""
    below = data.claim_hz if fmax is None else fmax
    return max(int(np.searchsorted(data.frequency[data.band_edges[:-1]], below)), 1)


def whiten(data: DriveData, covariance: FloatArray, x: FloatArray) -> FloatArray:
    """Coefficients (channel, frame, bin) with the noise's covariance taken out, flat: unit normal where x is noise."""
    inverse = np.linalg.inv(np.linalg.cholesky(covariance))
    band = data.band_of_bin
    if data.channel_count == 1:
        return (x[0] * inverse[:, 0, 0][band]).ravel()
    both = x[0] * inverse[:, 1, 0][band] + x[1] * inverse[:, 1, 1][band]
    return np.concatenate([(x[0] * inverse[:, 0, 0][band]).ravel(), both.ravel()])


def log_sum(logs: Sequence[float] | FloatArray) -> float:
    """Logarithm of the sum of exponentials."""
    return float(np.logaddexp.reduce(np.asarray(logs, float)))
