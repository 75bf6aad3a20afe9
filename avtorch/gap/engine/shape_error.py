r"""How wrong the shape of a named effect may be: an error in proportion to what the effect does, where it acts.

A named effect is an idealisation; its response is off by some per cent. In frame f and band b of the lapped transform
the C channels of the residual are Gaussian with the covariance

    V_fb = S_b + eps^2 G_fb,        G_fb = mean of x x' over the coefficients of the block,

where x is what the effects change in the response of the bare baseline, S_b is the noise, free in every band, and eps
is the relative error, half-normal. `shape_likelihood` maximises over S_b at each eps of a grid, `shape_log_prior` is
the prior on it, and the hypothesis's evidence takes the logarithm of the likelihood's mean under it. The maximum has no
closed form; with A = sum_f V^-1, B = sum_f V^-1 (r r') V^-1 and # the geometric mean of matrices,

    S <- A^-1 # (S B S)

never lowers the likelihood (it maximises a minorant: log det V is concave, tr V^-1 r r' convex in S; Hunter and Lange
2004, Sawada et al. 2013) and needs a fifth of EM's steps where the noise is small beside the error.

A coherent error of shape looks like a companion effect. `relative_size` is the size of the companion's response over
that of the effects where the companion acts, `shape_log_odds` what such a size is worth as an error of shape against a
cause of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit

from avtorch.arrays import FloatArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.likelihood import claim_bands
from avtorch.gap.engine.priors import SHAPE_ERROR, SHAPE_ERROR_FOUND, TEMPER

RELATIVE_ERRORS = (0.0, 0.015, 0.03, 0.06, 0.12, 0.24)
"""Relative errors of a response [-] at which the likelihood is evaluated: doublings around `SHAPE_ERROR`."""
_FLOOR = 1e-5  # least variance of the noise beside a shape error, relative to the residual's
_CORRELATED = 0.9999  # highest correlation of the channels' noise: a computed acceleration repeats the speed's
_FOUND_ONE_BY_ONE = "command_hold"


class ShapeLikelihood(NamedTuple):
    """What the relative errors of a grid leave of a residual, in the bands below `claim_hz`.

    `nats` (error,): log likelihood over that of an exact shape; `covariances` (error, band, channel, channel): of the
    noise, per coefficient; `counts` (error, band): effective number of coefficients per channel that measured it.
    """

    nats: FloatArray
    covariances: FloatArray
    counts: FloatArray


def error_scale(effects: Iterable[str]) -> float:
    """Scale of the half-normal relative error in the response of `effects`."""
    return SHAPE_ERROR_FOUND if _FOUND_ONE_BY_ONE in effects else SHAPE_ERROR


def shape_log_prior(effects: Iterable[str]) -> FloatArray:
    """Log prior probability (error,) of each of `RELATIVE_ERRORS` for the response of `effects`."""
    log_density = -0.5 * (np.array(RELATIVE_ERRORS) / error_scale(effects)) ** 2
    return log_density - np.log(np.exp(log_density).sum())


def frame_energy(data: DriveData, x: FloatArray) -> FloatArray:
    """Mean of x x' per coefficient in each frame and band, (frame, band, channel, channel), of x (channel, frame, bin).

    Unit: that of x, squared.
    """
    products = x[:, None] * x[None]
    sums = np.add.reduceat(products, data.band_edges[:-1], axis=-1)
    return np.ascontiguousarray(np.moveaxis(sums / np.diff(data.band_edges), (0, 1), (-2, -1)))


def effect_energy(data: DriveData, change: FloatArray) -> FloatArray:
    """Energy (frame, band, channel, channel) of what effects change in the response, `change` (channel, frame, bin).

    An error of shape need not sit where the effect does to the frame: a late or broadened response spills over. The
    energy is therefore smoothed by (1/4, 1/2, 1/4) over neighbouring frames and over neighbouring bands.
    """
    energy = frame_energy(data, change)
    for axis in (0, 1):
        ends = np.take(energy, [0], axis), np.take(energy, [-1], axis)
        padded = np.concatenate([ends[0], energy, ends[1]], axis)
        size = energy.shape[axis]
        before, after = np.take(padded, range(size), axis), np.take(padded, range(2, size + 2), axis)
        energy = 0.25 * before + 0.5 * energy + 0.25 * after
    return energy


def relative_size(data: DriveData, covariance: FloatArray, companion: FloatArray, energy: FloatArray) -> float:
    """Relative amplitude of a companion's response (channel, frame, bin) over effects of an energy, where it acts.

    Both are measured in units of the noise, `covariance` (band, channel, channel); the mean of the logarithm of the
    ratio over frames and bands below `claim_hz` is weighted by the companion's own information. `energy`: of
    `effect_energy`.
    """
    bands = claim_bands(data)
    weight = np.linalg.inv(covariance[:bands]) * np.diff(data.band_edges)[:bands, None, None]
    information = np.einsum("fbij,bij->fb", frame_energy(data, companion)[:, :bands], weight)
    reference = np.einsum("fbij,bij->fb", energy[:, :bands], weight)
    information, reference = np.maximum(information, 1e-12), np.maximum(reference, 1e-12)
    return float(np.exp(0.5 * np.average(np.log(information / reference), weights=information)))


def shape_likelihood(
    data: DriveData,
    residual: FloatArray,
    energy: FloatArray | None,
    iterations: int = 30,
) -> ShapeLikelihood | None:
    """Likelihood of each of `RELATIVE_ERRORS` in the effects behind a residual (channel, frame, bin).

    `energy` (frame, band, channel, channel): of the effects, `effect_energy`; without effects (None), there is no
    shape to be wrong, and the answer is None. `iterations` over the noise: 30 come within half a nat.
    """
    if energy is None:
        return None
    bands = claim_bands(data)
    observed = frame_energy(data, residual)[:, :bands]
    sizes = np.diff(data.band_edges)[:bands].astype(float)
    nats, covariances, counts = noise_beside(observed, energy[:, :bands], sizes, np.array(RELATIVE_ERRORS), iterations)
    total = nats.sum(1)
    return ShapeLikelihood(total - total[0], covariances, counts)


def noise_beside(
    observed: FloatArray, energy: FloatArray, sizes: FloatArray, errors: FloatArray, iterations: int = 30
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The noise of each band beside something random of squared `errors` (error,) times `energy` (frame, band, channel,
    channel) in a residual of energy `observed` (the same), `sizes` (band,) coefficients a frame: log likelihood [nats]
    (error, band), covariance (error, band, channel, channel), effective counts (error, band)."""
    channels = observed.shape[-1]
    nats, packed, counts = _noise_beside(
        _packed(observed, 1.0), _packed(energy, 0.0), sizes, errors, channels, iterations
    )
    covariances = np.stack([packed[..., :2], packed[..., 1:]], -2)[..., :channels, :channels]
    return nats, np.ascontiguousarray(covariances), counts


def shape_log_odds(relative: float, gain: float, effects: Iterable[str]) -> float:
    """Log odds that a companion is an error in the shape of `effects` rather than a cause of its own.

    `relative`: its `relative_size`; `gain` [nats]: what it adds to the evidence. The density of an error of shape is
    half-normal, that of a cause's size is one per unit of relative size. The likelihood is later raised to the power
    `TEMPER`, a prior is not: its logarithm is divided by that power in advance. A companion that gains nothing
    has no measured size, so its density narrows nothing down: the odds in its favour are at most its gain.
    """
    scale = error_scale(effects)
    log_density_at_zero = 0.5 * math.log(2.0 / math.pi) - math.log(scale)
    return min(log_density_at_zero / TEMPER, max(gain, 0.0)) - 0.5 * (relative / scale) ** 2 / TEMPER


def _packed(energy: FloatArray, alone: float) -> FloatArray:
    """Elements 00, 01, 11 of covariances (frame, band, channel, channel); a lone channel's partner is `alone`."""
    packed = np.zeros((*energy.shape[:2], 3))
    packed[..., 0], packed[..., 2] = energy[..., 0, 0], alone
    if energy.shape[-1] == 2:
        packed[..., 1], packed[..., 2] = energy[..., 0, 1], energy[..., 1, 1]
    return packed


@njit(cache=True, fastmath=True, error_model="numpy")
def _noise_beside(
    observed: FloatArray, energy: FloatArray, sizes: FloatArray, errors: FloatArray, channels: int, iterations: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The noise of each band beside an error of shape: log likelihood (error, band), covariance (error, band, 3),
    effective counts (error, band). `observed`, `energy` (frame, band, 3); `sizes` (band,) coefficients a frame."""
    frames, bands = observed.shape[0], observed.shape[1]
    nats = np.zeros((len(errors), bands))
    covariances = np.zeros((len(errors), bands, 3))
    counts = np.zeros((len(errors), bands))
    for band in range(bands):
        m0, m1, m2 = 0.0, 0.0, 0.0
        for f in range(frames):
            m0 += observed[f, band, 0] / frames
            m1 += observed[f, band, 1] / frames
            m2 += observed[f, band, 2] / frames
        least0, least2 = _FLOOR * max(m0, 1e-30), _FLOOR * max(m2, 1e-30)
        for e in range(len(errors)):
            square = errors[e] ** 2
            s0, s1, s2 = _proper(m0, m1, m2, least0, least2)
            rounds = iterations if square > 0.0 else 0
            for iteration in range(rounds + 1):
                value, effective = 0.0, 0.0
                a0, a1, a2, b0, b1, b2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for f in range(frames):
                    w0, w1, w2 = observed[f, band, 0], observed[f, band, 1], observed[f, band, 2]
                    v0 = s0 + square * energy[f, band, 0]
                    v1 = s1 + square * energy[f, band, 1]
                    v2 = s2 + square * energy[f, band, 2]
                    det = v0 * v2 - v1 * v1
                    i0, i1, i2 = v2 / det, -v1 / det, v0 / det
                    if iteration == rounds:
                        value -= 0.5 * sizes[band] * (math.log(det) + i0 * w0 + 2.0 * i1 * w1 + i2 * w2)
                        # share of the noise in the block's variance: its square is the information about the noise
                        share = s0 * i0 if channels == 1 else 0.5 * (s0 * i0 + 2.0 * s1 * i1 + s2 * i2)
                        effective += sizes[band] * share * share
                        continue
                    a0, a1, a2 = a0 + i0, a1 + i1, a2 + i2
                    x00, x01 = i0 * w0 + i1 * w1, i0 * w1 + i1 * w2
                    x10, x11 = i1 * w0 + i2 * w1, i1 * w1 + i2 * w2
                    b0 += x00 * i0 + x01 * i1
                    b1 += x00 * i1 + x01 * i2
                    b2 += x10 * i1 + x11 * i2
                if iteration < rounds:
                    x00, x01 = s0 * b0 + s1 * b1, s0 * b1 + s1 * b2
                    x10, x11 = s1 * b0 + s2 * b1, s1 * b1 + s2 * b2
                    b0, b1, b2 = _proper(x00 * s0 + x01 * s1, x00 * s1 + x01 * s2, x10 * s1 + x11 * s2, least0, least2)
                    det = a0 * a2 - a1 * a1
                    g0, g1, g2 = _geometric_mean(a2 / det, -a1 / det, a0 / det, b0, b1, b2)
                    s0, s1, s2 = _proper(g0, g1, g2, least0, least2)
            nats[e, band] = value
            covariances[e, band, 0], covariances[e, band, 1], covariances[e, band, 2] = s0, s1, s2
            counts[e, band] = effective
    return nats, covariances, counts


@njit(cache=True, fastmath=True, error_model="numpy")
def _proper(s0: float, s1: float, s2: float, least0: float, least2: float) -> tuple[float, float, float]:
    """The covariance with variances of at least `least0` and `least2`, and channels that are not quite the same."""
    s0, s2 = max(s0, least0), max(s2, least2)
    limit = _CORRELATED * math.sqrt(s0 * s2)
    return s0, min(max(s1, -limit), limit), s2


@njit(cache=True, fastmath=True, error_model="numpy")
def _geometric_mean(p0: float, p1: float, p2: float, q0: float, q1: float, q2: float) -> tuple[float, float, float]:
    """Geometric mean of two covariances of two channels, each by its elements 00, 01, 11 (Bhatia 2007, 4.1.12)."""
    p, q = math.sqrt(p0 * p2 - p1 * p1), math.sqrt(q0 * q2 - q1 * q1)
    g0, g1, g2 = p0 / p + q0 / q, p1 / p + q1 / q, p2 / p + q2 / q
    scale = math.sqrt(p * q / (g0 * g2 - g1 * g1))
    return scale * g0, scale * g1, scale * g2
