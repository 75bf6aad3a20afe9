"""What a find shows row by row, and what it has to pay before that counts.

Against the bare baseline a find's Bayes factor, less the price of having been picked among many, is an e-value. Of the
rows in some part of the drives, given all the others, the likelihood ratio is at least what they gain at the fitted
parameters less all that the fit has cost; so it is one too, and no part is named for what flexibility alone brings.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.crossval.random_effect_density import random_effect_density
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.likelihood.record import Record
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.selection.model_probabilities import complexity_penalties


@dataclass(frozen=True, eq=False)
class RowAttribution:
    """Of every counted row (counted,), by the find that all drives fit.

    `gained` [nats]: what it adds to the log density of the bare baseline; `paid` [nats], of all rows together: for
    its freedom, and for having been picked. `does` [nats]: what it is expected to add, half the square of the white
    image of what it changes; `felt` likewise of the accelerometer's faults alone. `moved` (channel, counted): the
    change itself.
    """

    record: Record
    gained: FloatArray = field(repr=False)
    paid: float
    does: FloatArray = field(repr=False)
    felt: FloatArray = field(repr=False)
    moved: FloatArray = field(repr=False)

    @classmethod
    def of(cls, race: SearchResult, found: FittedModel) -> RowAttribution:
        """Of a find of a search."""
        record = race.record
        told, bare = Refit.whole(found), Refit.whole(race.none)
        white = told.white(record)
        rows, flat = (r.white(record).row_likelihoods(r.errors) for r in (told, bare))
        gained = rows + random_effect_density(found, race.raw, record) - flat
        worth = found.log_evidence - race.none.log_evidence - complexity_penalties(race.found)[found.name]
        return cls(
            record=record,
            gained=gained,
            paid=float(gained.sum() - worth),
            does=_worth(white(told.effect)),
            felt=_worth(white(told.felt)),
            moved=told.effect.mean(-1),
        )

    @property
    def p_value(self) -> float:
        """A bound on it, of the bare baseline against the find: the inverse of the e-value."""
        return float(np.exp(-np.clip(self.gained.sum() - self.paid, 0.0, 700.0)))


def _worth(e: FloatArray) -> FloatArray:
    """Half the squares (counted,) of white images (channel, counted, group)."""
    return np.asarray(0.5 * (e**2).sum((0, 2)), np.float64)
