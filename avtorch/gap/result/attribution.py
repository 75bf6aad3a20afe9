"""What a hypothesis changes, row by row, in nats: the transform is orthonormal, so that nats of coefficients are nats
of rows.

In units of the noise, half the square of the change that a hypothesis makes to the prediction is what it is expected to
gain; the difference of the squared residuals is what it did gain. Both are spread over rows by the transform's adjoint.
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.answer.location import RowAttribution
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.simulator.effect import EFFECTS as TABLE


def row_attribution(rows: CountedRows, h: Hypothesis, base: Hypothesis) -> RowAttribution:
    """The attribution of an evaluated hypothesis over the base; both about the same data as `rows`."""
    before, after = _squares(h, base.residual), _squares(h, h.residual)
    gained = rows.of_rows(before - after).sum(1)
    total = float(h.log_likelihood - base.log_likelihood)
    if gained.sum() > 0:  # with the noise that each has, not with one noise for both
        gained = gained * total / gained.sum()
    cost = total - (h.evidence - base.evidence) + EFFECT_NATS * len(h.effects)
    does = rows.of_rows(_squares(h, h.predicted - base.predicted)).sum(1)
    sensed = _without_sensor(h)
    felt = np.zeros_like(does) if sensed is None else rows.of_rows(_squares(h, h.predicted - sensed)).sum(1)
    moved = (rows.simulated(h) - rows.simulated(base)).mean(-1)
    return RowAttribution(record=rows, gained=gained, paid=float(cost), does=does, felt=felt, moved=moved)


def _squares(h: Hypothesis, x: FloatArray) -> FloatArray:
    """Half the squares (row,) of coefficients (channel, frame, bin) in units of the noise."""
    data = h.data
    white = whiten(data, h.covariance, x).reshape(x.shape)
    return np.sum([0.5 * data.adjoint(c) ** 2 for c in white], axis=0)


def _without_sensor(h: Hypothesis) -> FloatArray | None:
    """The prediction without the sensor's effects; None where there are none."""
    own = [e for e in h.effects if base_name(e) in TABLE and TABLE[base_name(e)].place == "sensor"]
    if not own:
        return None
    values = h.values.copy()
    for e in own:
        for c in EFFECTS[e].coordinates:
            values[INDEX[c.name]] = h.neutral[INDEX[c.name]]
    return h.response(values)
