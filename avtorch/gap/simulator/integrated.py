"""A force that is linear in many coefficients, standard normal a priori, which a likelihood integrates out.

Its one parameter in the answer, `size`, scales all of them. A hypothesis has at most one such effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

from torch import Tensor

from avtorch.gap.simulator.effect import Effect


@dataclass(frozen=True)
class Integrated(Effect):
    """An effect of the body over position, with `knots` coefficients. `size`: the parameter that scales them.

    `prepared` sets the number of knots that a road needs. None of its parameters is a coordinate of a fit: the size is
    integrated over a grid, the coefficients in closed form.
    """

    size: ClassVar[str]

    @property
    def count(self) -> int:
        """Number of coefficients."""
        raise NotImplementedError(f"{type(self).__name__} has no count")

    def columns(self, position: Tensor) -> Tensor:
        """Acceleration (time, knot) per unit of each coefficient at size 1, `position` (time,) [m]."""
        raise NotImplementedError(f"{type(self).__name__} has no columns")

    def force(self, position: Tensor, coefficients: Tensor) -> Tensor:
        """Acceleration (..., time) of `coefficients` (..., knot), linear in them; `position` (time,) [m]."""
        raise NotImplementedError(f"{type(self).__name__} has no force")

    def magnitude(self, position: Tensor, coefficients: Tensor) -> Tensor:
        """The quantity whose root mean square is the size, (..., time), linear too, with the same arguments."""
        raise NotImplementedError(f"{type(self).__name__} has no magnitude")

    def size_along(self, position: Tensor) -> Tensor:
        """The size that the coefficients have over these places: a root mean square, (...); `position` (time,) [m]."""
        raise NotImplementedError(f"{type(self).__name__} has no size_along")

    def levelled(self, coefficients: Tensor) -> Tensor:
        """`coefficients` (..., knot) without the part that makes the same force everywhere."""
        return coefficients

    def spaced(self, knot_m: float) -> Self:
        """The effect with knots `knot_m` [m] apart, and as smooth as these can follow."""
        return self

    def along(self, coefficients: Tensor, size: float) -> Self:
        """The effect with this `size`, and `coefficients` (knot,) at size 1."""
        raise NotImplementedError(f"{type(self).__name__} has no along")
