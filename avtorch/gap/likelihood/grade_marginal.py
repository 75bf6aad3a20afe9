"""A road's slope integrated out: its coefficients exactly, its size over a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from avtorch.arrays import Float, FloatArray

SIZES = np.exp(np.linspace(np.log(2e-4), np.log(0.1), 97))
"""Values of `grade_rms` over which is integrated."""
_CENTRE, _SPREAD = 0.012, 1.2  # log-normal prior of `grade_rms`: about 1.2 %, wide towards faint


@dataclass(frozen=True, eq=False)
class GradeMarginal:
    """White `image` (knot, row) of the slope's columns turned to principal `axes` (knot, axis), and their squares."""

    image: Float[FloatArray, "axis row"] = field(repr=False)
    squares: Float[FloatArray, " axis"]
    axes: Float[FloatArray, "knot axis"] = field(repr=False)

    @classmethod
    def of(cls, image: Float[FloatArray, "knot row"]) -> GradeMarginal:
        """From the white image (knot, row) of each coefficient at `grade_rms` 1."""
        squares, axes = np.linalg.eigh(image @ image.T)
        return cls(axes.T @ image, np.maximum(squares, 0.0), axes)

    @property
    def shrinkage(self) -> Float[FloatArray, "size axis"]:
        """(size, knot): how much of each axis' match is taken for slope."""
        square = SIZES[:, None] ** 2
        return square / (1 + square * self.squares)

    @property
    def prior(self) -> Float[FloatArray, " size"]:
        """(size,): log prior mass of each size, with what its coefficients' spread costs."""
        away = (np.log(SIZES) - np.log(_CENTRE)) / _SPREAD
        mass = np.log(np.log(SIZES[1] / SIZES[0]) / (_SPREAD * np.sqrt(2 * np.pi)))
        return mass - 0.5 * away**2 - 0.5 * np.log1p(SIZES[:, None] ** 2 * self.squares).sum(1)

    def by_size(self, match: Float[FloatArray, "column axis"]) -> Float[FloatArray, "column size"]:
        """Log likelihood gained (column, size) by errors whose `match` with the axes is (column, knot)."""
        return self.prior + 0.5 * match**2 @ self.shrinkage.T

    def weighed(
        self, match: Float[FloatArray, "column axis"]
    ) -> tuple[Float[FloatArray, " column"], Float[FloatArray, "column axis"]]:
        """Log likelihood gained (column,) for a `match` (column, knot), and the share of each axis' taken for slope."""
        gains = self.by_size(match)
        total: FloatArray = np.asarray(logsumexp(gains, axis=1))
        return total, np.exp(gains - total[:, None]) @ self.shrinkage

    def told(self, errors: Float[FloatArray, " row"]) -> tuple[float, Float[FloatArray, " knot"]]:
        """The best `grade_rms`, and the posterior mean of the coefficients (knot,), given white errors (row,)."""
        match = (errors @ self.image.T)[None]
        _, taken = self.weighed(match)
        return float(SIZES[self.by_size(match)[0].argmax()]), (taken * match)[0] @ self.axes.T

    def gained(
        self, errors: Float[FloatArray, "column row"]
    ) -> tuple[Float[FloatArray, " column"], Float[FloatArray, "column row"]]:
        """Log likelihood gained (column,) by white errors (column, row), and what part of them is taken for slope."""
        match = errors @ self.image.T
        total, taken = self.weighed(match)
        return total, (taken * match) @ self.image

    def from_rows(self, errors: Float[FloatArray, "channel row"], rows: Sequence[int]) -> Float[FloatArray, " onset"]:
        """Log likelihood gained (onset,) by white errors (channel, row) if the slope acts from each of `rows` on only.

        What a coefficient does before an onset is cut off its image, which is as good as exact some rows after it.
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
        """Coefficients (column, knot) drawn given what errors have in common with the axes, (column, knot)."""
        gains = self.by_size(match)
        taken = self.shrinkage[(gains + rng.gumbel(size=gains.shape)).argmax(1)]
        return (taken * match + np.sqrt(taken) * rng.standard_normal(match.shape)) @ self.axes.T
