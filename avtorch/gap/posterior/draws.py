"""Draws from a posterior, by any method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from avtorch.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of coordinates `names`: `z` (chain, draw, coordinate) and `values` by key (chain, draw), in their units.

    `method`: "sgld"; "importance" where the posterior is too steep in places for Langevin steps; "laplace" where both
    fail. `effective`: effective sample size. `grade_rms` (chain, draw): of the road grade, where the hypothesis has
    one. `exact_share`: share of exact gradients. `why`: the reason why SGLD was not used.
    """

    names: tuple[str, ...]
    z: FloatArray = field(repr=False)
    values: Mapping[str, FloatArray] = field(repr=False)
    method: str = "sgld"
    effective: float = float("nan")
    grade_rms: FloatArray | None = field(default=None, repr=False)
    exact_share: float = 1.0
    why: str = ""
