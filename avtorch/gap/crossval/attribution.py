"""Evidence for a fitted model row by row, and the complexity cost that it must exceed.

Relative to the bare baseline, a model's Bayes factor less the penalty for selection among many hypotheses is an
e-value. For the rows of any part of the drives, given all other rows, the likelihood ratio is at least their gain at
the fitted parameters less the whole cost of the fit. This bound is an e-value too, so no part is named because of the
model's flexibility alone.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.location import RowAttribution
from avtorch.gap.crossval.random_effect_density import RandomEffectDensity
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.selection.model_probabilities import complexity_penalties


def row_attribution(race: SearchResult, found: FittedModel) -> RowAttribution:
    """The attribution of a fitted model of a search."""
    record = race.record
    fitted, bare = Refit.whole(found), Refit.whole(race.none)
    white = fitted.white(record)
    rows, flat = (r.white(record).row_likelihoods(r.errors) for r in (fitted, bare))
    gained = rows + RandomEffectDensity(found, race.raw)(record) - flat
    net_gain = found.log_evidence - race.none.log_evidence - complexity_penalties(race.found)[found.name]
    return RowAttribution(
        record=record,
        gained=gained,
        paid=float(gained.sum() - net_gain),
        does=_expected_gain(white(fitted.effect)),
        felt=_expected_gain(white(fitted.felt)),
        moved=fitted.effect.mean(-1),
    )


def _expected_gain(e: FloatArray) -> FloatArray:
    """Half the sum of squares (counted,) of whitened images (channel, counted, group)."""
    return np.asarray(0.5 * (e**2).sum((0, 2)), np.float64)
