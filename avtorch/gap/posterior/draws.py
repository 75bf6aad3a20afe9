"""Draws of a posterior, however they were made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from avtorch.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class Draws:
    """Draws of coordinates `names`: `z` (chain, draw, coordinate) and `values` by key (chain, draw), in their units.

    `method`: "sgld", or "importance" where the posterior has cliffs on which Langevin steps fail, "laplace" where
    either fails. `effective`: about how many independent draws they are worth. `grade_rms` (chain, draw): of a road's
    slope, where the candidate has one. `exact_share`: of the gradients, those that were exact. `why` SGLD was given up.
    """

    names: tuple[str, ...]
    z: FloatArray = field(repr=False)
    values: Mapping[str, FloatArray] = field(repr=False)
    method: str = "sgld"
    effective: float = float("nan")
    grade_rms: FloatArray | None = field(default=None, repr=False)
    exact_share: float = 1.0
    why: str = ""
