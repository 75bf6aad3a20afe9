"""Where the unexplained part of a gap lies, and which effect it resembles.

What a regression without physics predicts of held-out blocks is reproducible (`flexible_regression`). On each axis the
part named is the shortest stretch that holds most of it, if clearly fewer rows lie there, and if the blocks agree
that the prediction holds within it. The effect it resembles is the one of which a score test at the selected model
promises most, of all that are registered; it did not enter, or was not asked for, so it is a hint for whoever looks and
no cause.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import stdtr
from scipy.stats import false_discovery_control

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import Unexplained
from avtorch.gap.answer.location import PLAINLY, RATE, Axis, Location, shortest
from avtorch.gap.budget.entry import candidates_for, observable
from avtorch.gap.budget.flexible_regression import predicted_residuals
from avtorch.gap.budget.held_out_evidence import agreement
from avtorch.gap.budget.rollout_energy import held_out_residuals
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.likelihood.basis import lowpass
from avtorch.gap.simulator.effect import EFFECTS

_MOST = 0.8  # share of the energy predicted that a part holds; some of it is always spread thinly
_MUCH = 0.5  # of what the regression gains, from which an effect resembles it
_NEARLY = 0.8  # of the best effect's promise, from which a simpler one takes its place


def placed(rest: Unexplained, selection: Selection, *, epoch_s: float = 0.0) -> Unexplained:
    """`rest` with its places and the effect it resembles; as it is where nothing material is left.

    `epoch_s`: the first log's start on its own clock.
    """
    if not rest.material:
        return rest
    fitting, last = selection.fitting, selection.last
    residuals = held_out_residuals(selection, last)
    predicted = predicted_residuals(fitting, last.fit, residuals)
    if not predicted.any():
        return rest
    white = fitting.whitening(residuals)
    gain = float((fitting.nats(white) - fitting.nats(white - fitting.whitening(predicted))).sum())
    where = _places(selection, residuals, predicted, epoch_s)
    return replace(rest, where=where, resembles=_resembling(selection, gain))


def _places(selection: Selection, residuals: FloatArray, predicted: FloatArray, epoch_s: float) -> tuple[Location, ...]:
    fitting, fit = selection.fitting, selection.last.fit
    record, whitening = fitting.whitening.record, fitting.whitening
    white, found = whitening(residuals), whitening(predicted)
    score, size = white * found, found**2
    # not whitened: white residuals hold little but what is quick, and a place is of what a rollout shows
    does = ((predicted / residuals[:, record.counts].std(-1)[:, None]) ** 2).sum(0) * record.counts
    lag = float(fit.model.values(fit.z)["T_L"])
    axes: list[tuple[Axis, FloatArray]] = [("command", lowpass(record.command, lag, record.dt))]
    if record.has_speed:
        axes.append(("speed", record.speed))
    if len(np.unique(record.log)) == 1:
        axes.append(("time", record.time))
    parts: list[Location] = []
    for axis, x in axes:
        low, high = shortest(x[record.counts], does[record.counts], _MOST)
        inside = (x >= low) & (x <= high)
        if inside[record.counts].mean() > PLAINLY:
            continue
        rows = inside[whitening.order]
        errors, freedom = agreement(whitening.by_block(score * rows), whitening.by_block(size * rows))
        share = float(does[inside].sum() / does.sum())
        shift = epoch_s if axis == "time" else 0.0
        parts.append(Location(axis, low + shift, high + shift, share, float(stdtr(freedom, -errors))))
    if not parts:
        return ()
    q_values = false_discovery_control([part.q_value for part in parts])
    sure = [replace(part, q_value=float(q)) for part, q in zip(parts, q_values, strict=True) if q <= RATE]
    return tuple(sorted(sure, key=lambda part: part.q_value))


def _resembling(selection: Selection, gain: float) -> str | None:
    """The effect not selected that promises most, if that is much of the `gain` [nats]."""
    kinds = observable(EFFECTS.values(), selection.fitting.whitening.record)
    candidates = candidates_for(selection.fitting, selection.last, kinds, None, "")
    best = max((c.promise for c in candidates), default=0.0)
    if best < _MUCH * max(gain, 1.0):
        return None
    # a free course of the road follows whatever is simpler too
    simplest = min((c for c in candidates if c.promise >= _NEARLY * best), key=lambda c: c.model.size)
    return simplest.model.names[-1]
