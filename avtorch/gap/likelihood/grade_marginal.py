"""The road grade integrated out: its coefficients exactly, its size over a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from avtorch.arrays import Float, FloatArray

SIZES = np.exp(np.linspace(np.log(2e-4), np.log(0.1), 97))
"""Grid of `grade_rms` over which the size is integrated."""
_CENTRE, _SPREAD = 0.012, 1.2  # log-normal prior of `grade_rms`: about 1.2 %, wide towards small values


@dataclass(frozen=True, eq=False)
class GradeMarginal:
    """Whitened `image` (axis, row) of the grade's columns in principal `axes` (knot, axis), and their squared norms."""

    image: Float[FloatArray, "axis row"] = field(repr=False)
    squares: Float[FloatArray, " axis"]
    axes: Float[FloatArray, "knot axis"] = field(repr=False)

    @classmethod
    def of(cls, image: Float[FloatArray, "knot row"]) -> GradeMarginal:
        """The marginal from the whitened image (knot, row) of each coefficient at `grade_rms` 1."""
        squares, axes = np.linalg.eigh(image @ image.T)
        return cls(axes.T @ image, np.maximum(squares, 0.0), axes)

    @property
    def shrinkage(self) -> Float[FloatArray, "size axis"]:
        """(size, axis): posterior mean of each axis' coefficient per unit of its match."""
        square = SIZES[:, None] ** 2
        return square / (1 + square * self.squares)

    @property
    def prior(self) -> Float[FloatArray, " size"]:
        """(size,): log prior mass of each size, with the Occam factor of its coefficients."""
        away = (np.log(SIZES) - np.log(_CENTRE)) / _SPREAD
        mass = np.log(np.log(SIZES[1] / SIZES[0]) / (_SPREAD * np.sqrt(2 * np.pi)))
        return mass - 0.5 * away**2 - 0.5 * np.log1p(SIZES[:, None] ** 2 * self.squares).sum(1)

    def by_size(self, match: Float[FloatArray, "column axis"]) -> Float[FloatArray, "column size"]:
        """Gain in log likelihood (column, size) from errors whose `match` with the axes is (column, axis)."""
        return self.prior + 0.5 * match**2 @ self.shrinkage.T

    def weighed(
        self, match: Float[FloatArray, "column axis"]
    ) -> tuple[Float[FloatArray, " column"], Float[FloatArray, "column axis"]]:
        """Gain in log likelihood (column,) for a `match` (column, axis), and the mean shrinkage of each axis."""
        gains = self.by_size(match)
        total: FloatArray = np.asarray(logsumexp(gains, axis=1))
        return total, np.exp(gains - total[:, None]) @ self.shrinkage

    def estimate(self, errors: Float[FloatArray, " row"]) -> tuple[float, Float[FloatArray, " knot"]]:
        """The best `grade_rms`, and the posterior mean of the coefficients (knot,), given whitened errors (row,)."""
        match = (errors @ self.image.T)[None]
        _, taken = self.weighed(match)
        return float(SIZES[self.by_size(match)[0].argmax()]), (taken * match)[0] @ self.axes.T

    def gained(
        self, errors: Float[FloatArray, "column row"]
    ) -> tuple[Float[FloatArray, " column"], Float[FloatArray, "column row"]]:
        """Gain in log likelihood (column,) from whitened errors (column, row), and their part fitted by the grade."""
        match = errors @ self.image.T
        total, taken = self.weighed(match)
        return total, (taken * match) @ self.image

    def from_rows(self, errors: Float[FloatArray, "channel row"], rows: Sequence[int]) -> Float[FloatArray, " onset"]:
        """Gain in log likelihood (onset,) from whitened errors (channel, row) if the grade acts only from each of
        `rows` on.

        The part of a coefficient's image before the onset is cut off, which is nearly exact from some rows after the
        onset.
        """
        image = self.image.reshape(len(self.image), *errors.shape)
        ends = [*sorted(rows), errors.shape[-1]]
        gram: FloatArray = np.zeros((len(image), len(image)))
        match: FloatArray = np.zeros(len(image))
        found: dict[int, float] = {}
        for begin, end in reversed(list(pairwise(ends))):
            part = image[..., begin:end].reshape(len(image), -1)
            gram, match = gram + part @ part.T, match + part @ errors[:, begin:end].ravel()
            squares, axes = np.linalg.eigh(gram)
            late = GradeMarginal(np.zeros((len(image), 0)), np.maximum(squares, 0.0), axes)
            found[begin] = float(late.weighed((match @ axes)[None])[0][0])
        return np.array([found[row] for row in rows])

    def sampled(
        self, match: Float[FloatArray, "column axis"], rng: np.random.Generator
    ) -> Float[FloatArray, "column knot"]:
        """Posterior draws of the coefficients (column, knot), given the errors' match with the axes (column, axis)."""
        gains = self.by_size(match)
        taken = self.shrinkage[(gains + rng.gumbel(size=gains.shape)).argmax(1)]
        return (taken * match + np.sqrt(taken) * rng.standard_normal(match.shape)) @ self.axes.T
