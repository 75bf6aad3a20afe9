"""A force that is linear in many coefficients, standard normal a priori, which a likelihood integrates out.

Its one parameter in the answer, `size`, scales all of them. A hypothesis has at most one such effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

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
