r"""Noise of a drive and its likelihood from the spectrum of a residual, by Whittle's approximation.

The noise of both channels: white jerk through the lag (an Ornstein-Uhlenbeck acceleration of time constant T_L, in both
channels), white noise of each sensor, and, with gusts, a slower Ornstein-Uhlenbeck acceleration. Over the
frequencies `w` of the real transform of a residual,

    -log L = sum_k log det S(w_k) + R_k* S(w_k)^-1 R_k / rows

which is the Gaussian likelihood up to edges and gaps (Whittle 1953), and costs a few transforms.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.optimize import minimize

from avtorch.arrays import BoolArray, FloatArray

Complex = NDArray[Any]  # complex or real


@dataclass(frozen=True, eq=False)
class Shapes:
    """Spectral matrices (part, frequency, channel, channel) of the noise's parts at size 1."""

    parts: Complex

    def total(self, sizes: FloatArray) -> Complex:
        """The noise's spectrum at these sizes (part,)."""
        return np.tensordot(sizes, self.parts, 1)


class Spectrum:
    """Frequencies of residuals (channel, row) of which `valid` rows are not 0, `step` [s] apart."""

    def __init__(self, valid: BoolArray, step: float, channels: tuple[str, ...]) -> None:
        self.rows, self.step, self.channels = int(valid.sum()), step, channels
        self.length = int(next_fast_len(len(valid), real=True) or len(valid))
        count = self.length // 2 + 1
        self.frequency = 2 * np.pi * np.arange(count) / self.length  # per row
        self.weight = np.ones(count)
        self.weight[0] = 0.5
        if self.length % 2 == 0:
            self.weight[-1] = 0.5
        # bands of the noise fit: the mean alone, then bands of increasing width
        edges = np.unique(np.concatenate([[0, 1], np.geomspace(1, count, 70).astype(int)]))
        self._starts = edges[:-1]
        self._band_weight = np.add.reduceat(self.weight, self._starts)
        self._middle = np.add.reduceat(self.weight * self.frequency, self._starts) / self._band_weight

    def transform(self, residual: FloatArray) -> Complex:
        """(..., channel, row) to (..., frequency, channel)."""
        return np.moveaxis(np.fft.rfft(residual, self.length), -1, -2)

    def bands(self, transformed: Complex) -> Complex:
        """Mean of `R R*` / rows by band: (band, channel, channel)."""
        power = transformed[:, :, None] * transformed[:, None, :].conj() * (self.weight / self.rows)[:, None, None]
        return np.add.reduceat(power, self._starts, 0) / self._band_weight[:, None, None]

    def shapes(self, lag: float, gust_time: float | None, *, banded: bool) -> Shapes:
        """Parts of the noise: process, one sensor each, and gusts of time constant `gust_time` [s]."""
        turn = np.exp(1j * (self._middle if banded else self.frequency))
        size = len(self.channels)
        into = {"accel": np.ones_like(turn), "speed": 0.5 * self.step * (1 + turn)}
        gain = np.stack([into[name] for name in self.channels], -1)
        both = gain[:, :, None] * gain[:, None, :].conj()
        parts = [both * _coloured(turn, self.step / lag)[:, None, None]]
        for i, name in enumerate(self.channels):
            own = np.zeros((len(turn), size, size), complex)
            own[:, i, i] = 1.0 if name == "accel" else np.abs(turn - 1) ** 2 + 1e-6
            parts.append(own)
        if gust_time is not None:
            parts.append(both * _coloured(turn, self.step / gust_time)[:, None, None])
        return Shapes(np.stack(parts))

    def loss(self, bands: Complex, spectrum: Complex) -> float:
        """-log likelihood, constants left out, from banded power and a banded spectrum."""
        inverse, log_det = _inverse(spectrum)
        fit = np.einsum("bij,bji->b", inverse, bands).real
        return float(self.rows / self.length * np.sum(self._band_weight * (log_det + fit)))

    def fit_noise(
        self, bands: Complex, lag: float, start: FloatArray | None, gust: bool
    ) -> tuple[float, FloatArray, float | None]:
        """Maximum likelihood sizes (part,) of the noise given these bands: loss, sizes, time constant of the gusts."""
        if not gust:
            return *self._fit(bands, self.shapes(lag, None, banded=True), start), None
        tries = [(*self._fit(bands, self.shapes(lag, t, banded=True), None), t) for t in (1.0, 2.0, 4.0)]
        return min(tries, key=lambda one: one[0])

    def _fit(self, bands: Complex, shapes: Shapes, start: FloatArray | None) -> tuple[float, FloatArray]:
        weight = self.rows / self.length * self._band_weight
        parts = shapes.parts
        if start is None or len(start) != len(parts):
            start = np.full(len(parts), 1e-3)
            start[1 : 1 + len(self.channels)] = 1e-3
        floor = np.log(1e-8)

        def value(logs: FloatArray) -> tuple[float, FloatArray]:
            sizes = np.exp(logs)
            inverse, log_det = _inverse(np.tensordot(sizes, parts, 1))
            middle = inverse - inverse @ bands @ inverse
            fit = np.einsum("bij,bji->b", inverse, bands).real
            slope = np.einsum("b,bij,pbji->p", weight, middle, parts).real * sizes
            return float(np.sum(weight * (log_det + fit))), slope

        found = minimize(
            value,
            np.maximum(np.log(start), floor),
            jac=True,
            method="L-BFGS-B",
            bounds=[(floor, 3.0)] * len(parts),
            options={"maxiter": 40, "ftol": 1e-9},
        )
        return float(found.fun), np.exp(found.x)

    def inverse(self, lag: float, sizes: FloatArray, gust_time: float | None) -> Complex:
        """`S^-1` (frequency, channel, channel), weighted so that `sum R* S^-1 R` is the quadratic form of -log L."""
        inverse, _ = _inverse(self.shapes(lag, gust_time, banded=False).total(sizes))
        return inverse * (self.weight / self.length)[:, None, None]


def _coloured(turn: Complex, ratio: float) -> FloatArray:
    """Spectrum of an Ornstein-Uhlenbeck process of variance 1 whose time constant is `1 / ratio` rows."""
    keep = np.exp(-ratio)
    return (1 - keep**2) / np.abs(1 - keep / turn) ** 2


def _inverse(matrix: Complex) -> tuple[Complex, FloatArray]:
    """Inverse and log determinant of Hermitian matrices (..., n, n), n at most 2."""
    if matrix.shape[-1] == 1:
        return 1 / matrix, np.log(np.real(matrix[..., 0, 0]))
    a, b, d = np.real(matrix[..., 0, 0]), matrix[..., 0, 1], np.real(matrix[..., 1, 1])
    det = np.maximum(a * d - np.abs(b) ** 2, 1e-30)
    inverse = np.empty_like(matrix)
    inverse[..., 0, 0], inverse[..., 1, 1] = d / det, a / det
    inverse[..., 0, 1], inverse[..., 1, 0] = -b / det, -b.conj() / det
    return inverse, np.log(det)
