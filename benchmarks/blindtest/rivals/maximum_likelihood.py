"""Maximum likelihood of one plant: deterministic effects by Gauss-Newton, the noise refitted at every step.

The noise of both channels: white jerk through the lag (an Ornstein-Uhlenbeck acceleration of time constant T_L, in both
channels), white noise of each sensor, and, with gusts, a slower Ornstein-Uhlenbeck acceleration. Over the
frequencies `w` of the real transform of a residual,

    -log L = sum_k log det S(w_k) + R_k* S(w_k)^-1 R_k / rows

which is the Gaussian likelihood up to edges and gaps (Whittle 1953), and costs a few transforms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.fft import next_fast_len
from scipy.optimize import minimize

from avtorch.arrays import BoolArray, FloatArray
from avtorch.gap import EFFECTS, GapPlant, plant
from benchmarks.blindtest.rivals.residuals import Residuals

_STEPS = 12
_WIDE = 0.05  # half width of the central differences, in the prior's SDs
_REACH = 6.0  # bound on a coordinate's distance from its prior's centre, in the prior's SDs


@dataclass(frozen=True, eq=False)
class MaximumLikelihoodFit:
    """A fitted candidate. `z`: coordinates by name, each on the scale of its prior; `loss` = -log L.

    `transformed` residual; `sizes`, `gust_time` of the noise; `inverse` its spectrum's; `lag` T_L [s]. `slope` of the
    response and `sd`, as `z`, are computed on demand.
    """

    effects: tuple[str, ...]
    plant: GapPlant
    z: Mapping[str, float]
    loss: float
    transformed: Complex
    sizes: FloatArray
    gust_time: float | None
    inverse: Complex
    lag: float
    slope_at: Callable[[], Complex]

    @cached_property
    def slope(self) -> Complex:
        """(coordinate, frequency, channel)."""
        return self.slope_at()

    @cached_property
    def sd(self) -> dict[str, float]:
        hessian, _ = _normal(self.slope, self.inverse, self.transformed)
        spread = np.sqrt(np.diag(np.linalg.inv(hessian + np.eye(len(hessian)))))
        return dict(zip(self.z, spread.tolist(), strict=True))

    def values(self) -> dict[str, tuple[float, float]]:
        """Mean and standard deviation of each coordinate in its own unit."""
        own = self.plant.parameters()
        out = {}
        for name, z in self.z.items():
            at = torch.tensor([z, z - 0.5 * self.sd[name], z + 0.5 * self.sd[name]], dtype=torch.float64)
            mean, low, high = own[name].constrain(at).tolist()
            out[name] = (mean, abs(high - low))
        return out


class Fitter:
    """Fits candidates to one drive."""

    def __init__(self, drive: Residuals) -> None:
        self.drive = drive
        self.spectrum = Spectrum(drive.valid, drive.step, drive.channels)

    def fit(
        self,
        effects: Sequence[str] = (),
        *,
        near: MaximumLikelihoodFit | None = None,
        gust: bool = False,
        steps: int = _STEPS,
    ) -> MaximumLikelihoodFit:
        """The most likely plant with `effects`.

        `near`: a fit to begin from (T_L, K_L and the effects it shares); the first two coordinates that are new are
        tried at a few typical values.
        """
        made = plant([EFFECTS[name] for name in effects]).prepared(self.drive.drives[0])
        names = list(made.parameters())
        begin = np.array([dict(near.z).get(name, 0.0) if near else 0.0 for name in names])
        known = near.z if near else {}
        starts = self._starts(names, begin, known)
        misses = self._misses(made, names, starts)
        sizes = near.sizes if near else None
        best = 0
        if len(starts) > 1 and near is not None:
            losses = self._quadratic(misses, near.inverse)
            best = int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))
        z = starts[best]
        state = self._state(made, names, z, misses[best], sizes, gust)
        damping = 1e-3
        for _ in range(steps):
            loss, transformed, sizes, _, inverse, _ = state
            slope = self._slope(made, names, z)
            hessian, downhill = _normal(slope, inverse, transformed)
            moved = False
            for _ in range(4):
                scaled = hessian + np.diag(damping * np.diag(hessian) + 1e-3)
                step = np.clip(np.linalg.solve(scaled, downhill), -1.5, 1.5)
                tried = np.clip(z + step, -_REACH, _REACH)
                after = self._state(made, names, tried, self._misses(made, names, tried[None])[0], sizes, gust)
                if after[0] < loss:
                    z, state, moved, damping = tried, after, True, damping / 5
                    break
                damping = max(10 * damping, 1e-2)
            if not moved or loss - state[0] < 0.05:
                break
        loss, transformed, sizes, gust_time, inverse, lag = state
        named = dict(zip(names, z.tolist(), strict=True))
        slope_at = partial(self._slope, made, names, z)
        return MaximumLikelihoodFit(
            tuple(effects), made, named, loss, transformed, sizes, gust_time, inverse, lag, slope_at
        )

    def _starts(self, names: Sequence[str], begin: FloatArray, known: Mapping[str, float]) -> FloatArray:
        """Coordinates (start, coordinate) at which to begin."""
        new = [i for i, name in enumerate(names) if name not in known and "." in name]
        if not new:
            return begin[None]
        # a limit far below the drive's demand is slow to evaluate, and was never the best start
        firsts = (0.0, 1.5, 3.0) if names[new[0]].startswith("rate_limit.") else (-1.5, 0.0, 1.5)
        if names[new[-1]].startswith("gain_change."):
            seconds = np.linspace(-1.2, 1.2, 7).tolist()
        else:
            seconds = [-1.5, 0.0, 1.5] if len(new) == 2 else [0.0]
        starts = []
        for first in firsts:
            for second in seconds:
                z = begin.copy()
                z[new[: 2 if len(new) > 1 else 1]] = [first, second][: len(new)]
                starts.append(z)
        return np.stack(starts)

    def _misses(self, made: GapPlant, names: Sequence[str], z: FloatArray) -> FloatArray:
        own = made.parameters()
        values = {name: own[name].constrain(torch.as_tensor(z[:, i].copy())) for i, name in enumerate(names)}
        return self.drive.misses(made, values)

    def _quadratic(self, misses: FloatArray, inverse: Complex) -> FloatArray:
        transformed = self.spectrum.transform(misses)
        return np.einsum("skc,kcd,skd->s", transformed.conj(), inverse, transformed, optimize=True).real

    def _state(
        self,
        made: GapPlant,
        names: Sequence[str],
        z: FloatArray,
        missed: FloatArray,
        sizes: FloatArray | None,
        gust: bool,
    ) -> Any:
        lag = float(made.parameters()["T_L"].constrain(torch.tensor(z[0], dtype=torch.float64)))
        transformed = self.spectrum.transform(missed)
        bands = self.spectrum.bands(transformed)
        if not np.isfinite(bands).all():  # outside the effect's domain
            return np.inf, transformed, sizes, None, None, lag
        loss, sizes, gust_time = self.spectrum.fit_noise(bands, lag, sizes, gust)
        return loss, transformed, sizes, gust_time, self.spectrum.inverse(lag, sizes, gust_time), lag

    def _slope(self, made: GapPlant, names: Sequence[str], z: FloatArray) -> Complex:
        """Derivative of the transformed response, (coordinate, frequency, channel), by central differences.

        The differences are wide, because at a kink of the response (a delay of whole rows) a narrow one gives a wrong
        slope.
        """
        away = _WIDE * np.eye(len(names))
        missed = np.nan_to_num(self._misses(made, names, np.concatenate([z - away, z + away])))
        return self.spectrum.transform((missed[: len(names)] - missed[len(names) :]) / (2 * _WIDE))


def _normal(slope: Complex, inverse: Complex, transformed: Complex) -> tuple[FloatArray, FloatArray]:
    """The Gauss-Newton matrix, and the direction of descent."""
    weighed = np.einsum("kcd,pkd->pkc", inverse, slope)
    flat = weighed.reshape(len(slope), -1).conj()
    return 2 * (flat @ slope.reshape(len(slope), -1).T).real, 2 * (flat @ transformed.ravel()).real


# Noise of a drive and its likelihood from the spectrum of a residual, by Whittle's approximation.
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
