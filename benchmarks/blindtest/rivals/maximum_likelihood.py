"""Maximum likelihood of one plant: deterministic effects by Gauss-Newton, the noise refitted at every step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap import EFFECTS, GapPlant, plant
from benchmarks.blindtest.rivals.residuals import Residuals
from benchmarks.blindtest.rivals.spectrum import Complex, Spectrum

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
