"""The noise floor: residual error of the verdict, with the uncertainty of its parameters.

The parameters' posterior makes every rollout uncertain, and so the residual noise. Along the posterior's axes the
errors change by images `I`; with `z` standard normal the noise is `e + I z`, and its sum of squares in each block is a
quadratic form of `(1, z)`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avtorch.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Quadratic forms of `(1, z)`, `z` along the axes of the posterior.

    `squares` (measure, block, 1 + axis, 1 + axis): of rollout errors. `nats` (block, 1 + axis, 1 + axis): shortfall of
    the log density from its best value.
    """

    squares: FloatArray
    nats: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[NoiseFloor]) -> NoiseFloor:
        """The blocks of several folds, concatenated."""
        return cls(np.concatenate([p.squares for p in parts], 1), np.concatenate([p.nats for p in parts]))

    @property
    def axes(self) -> int:
        return self.nats.shape[-1] - 1


def expected(form: FloatArray) -> FloatArray:
    """Mean (...,) over `z` of a form (..., 1 + axis, 1 + axis)."""
    return np.trace(form, axis1=-2, axis2=-1)


def drawn(form: FloatArray, z: FloatArray) -> FloatArray:
    """Values (draw, ...) of a form (..., 1 + axis, 1 + axis) at `z` (draw, axis)."""
    known = np.concatenate([np.ones((len(z), 1)), z], 1)
    half = known @ form.reshape(-1, *form.shape[-2:])  # by matrix products: einsum of all three takes 20 times as long
    return np.einsum("fdj,dj->df", half, known).reshape(len(z), *form.shape[:-2])
