"""Evidence for a fitted model row by row, and the complexity cost that it must exceed.

Relative to the bare baseline, a model's Bayes factor less the penalty for selection among many hypotheses is an
e-value. For the rows of any part of the drives, given all other rows, the likelihood ratio is at least their gain at
the fitted parameters less the whole cost of the fit. This bound is an e-value too, so no part is named because of the
model's flexibility alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.crossval.random_effect_density import RandomEffectDensity
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.likelihood.record import Record
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.selection.model_probabilities import complexity_penalties


@dataclass(frozen=True, eq=False)
class RowAttribution:
    """Gain and effect of a model fitted to all drives, for every counted row (counted,).

    `gained` [nats]: gain in log density over the bare baseline. `paid` [nats], for all rows together: the cost of the
    fitted parameters and of the selection. `does` [nats]: expected gain, half the square of the whitened change in the
    rollout; `felt` [nats]: the same for the accelerometer's faults alone. `moved` (channel, counted): the change
    itself.
    """

    record: Record
    gained: FloatArray = field(repr=False)
    paid: float
    does: FloatArray = field(repr=False)
    felt: FloatArray = field(repr=False)
    moved: FloatArray = field(repr=False)

    @classmethod
    def of(cls, race: SearchResult, found: FittedModel) -> RowAttribution:
        """The attribution of a fitted model of a search."""
        record = race.record
        fitted, bare = Refit.whole(found), Refit.whole(race.none)
        white = fitted.white(record)
        rows, flat = (r.white(record).row_likelihoods(r.errors) for r in (fitted, bare))
        gained = rows + RandomEffectDensity(found, race.raw)(record) - flat
        net_gain = found.log_evidence - race.none.log_evidence - complexity_penalties(race.found)[found.name]
        return cls(
            record=record,
            gained=gained,
            paid=float(gained.sum() - net_gain),
            does=_expected_gain(white(fitted.effect)),
            felt=_expected_gain(white(fitted.felt)),
            moved=fitted.effect.mean(-1),
        )

    @property
    def p_value(self) -> float:
        """Upper bound on the p-value of the bare baseline against the model: the inverse of the e-value."""
        return float(np.exp(-np.clip(self.gained.sum() - self.paid, 0.0, 700.0)))


def _expected_gain(e: FloatArray) -> FloatArray:
    """Half the sum of squares (counted,) of whitened images (channel, counted, group)."""
    return np.asarray(0.5 * (e**2).sum((0, 2)), np.float64)
