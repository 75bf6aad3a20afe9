"""Since when an effect acts: the row from which the model with it is better than the model without.

A model's response switches from one to the other at the onset, so for given parameters two simulations price every row.
From the best one the parameters are fitted anew, by turns. A score test cannot do that: it knows the response near the
fit without the effect, whose lag and gain make up for as much of it as they can.
"""

from __future__ import annotations

import numpy as np

from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.simulator.integrated import Integrated

ONSET_NATS = 6.0
"""What an onset must gain."""
_TURNS, _ITERATIONS = 6, 8  # of effect and onset at most, and of a fit between two turns
_LEAST_NATS = 1.0  # that a turn promises
_NEAR_S = 3.0  # on either side of the onset found first, where each row is priced exactly


def may_set_in(model: EffectModel, name: str) -> bool:
    """Whether an onset is looked for: not of a force along the road, of what has a change of its own, or in several
    drives, which would each have one."""
    kind = next(effect for effect in model.effects if effect.name == name)
    return kind.own_onset is None and not issubclass(kind, Integrated) and len(set(model.record.log)) == 1


def best_onset(fitting: RobustFit, fit: Fit, name: str) -> tuple[float, float] | None:
    """From when [s] the effect `name` would be best to act, its parameters as they are, and what that gains [nats].

    None where no row has a block on either side.
    """
    record, whitening = fit.model.record, fitting.whitening
    inner = (record.block[whitening.order] > 0) & (record.block[whitening.order] < record.blocks - 1)
    if not inner.any():
        return None
    # not the model without an onset, which lacks the parameters that only an effect with one has
    always = fit.model.setting_in(name, -np.inf)
    never = fit.model.without(name)
    now = fitting.white(fit.model, fit.z)
    with_it = now if name not in fit.model.onsets else fitting.white(always, always.coordinates(fit.known))
    without = fitting.white(never, never.coordinates(fit.known))
    weight = 0.5 * fitting.weights(now, np.ones(whitening.blocks))
    by_time = np.argsort(whitening.order, kind="stable")
    gain = (weight * (without**2 - with_it**2).sum(0))[by_time]
    # what acting from each row on gains over never
    later = np.cumsum(gain[::-1])[::-1]
    best = record.time[whitening.order[by_time][int(np.argmax(np.where(inner[by_time], later, -np.inf)))]]
    # where noise wanders, what sets in shows by its first row most of all: the filter has to see the response switch
    ends = [record.measured - m.simulate(m.coordinates(fit.known)) for m in (never, always)]
    onsets = np.unique(record.time[whitening.order[inner]])
    onsets = onsets[np.abs(onsets - best) <= _NEAR_S]
    costs = [
        float((weight * whitening(np.where(record.time >= onset, ends[1], ends[0])) ** 2).sum()) for onset in onsets
    ]
    number = int(np.argmin(costs))
    return float(onsets[number]), float((weight * (now**2).sum(0)).sum()) - costs[number]


def set_in(fitting: RobustFit, fit: Fit, name: str, *, turns: int = _TURNS, iterations: int = _ITERATIONS) -> Fit:
    """The fit with the effect `name` acting from the onset on that fits best, found by turns; `fit` where none does."""
    best = fit
    for _ in range(turns):
        found = best_onset(fitting, best, name)
        if found is None or found[1] < _LEAST_NATS:
            break
        model = fit.model.setting_in(name, found[0])
        trial = fitting.fit(model, model.coordinates(best.known)[None], iterations=iterations)
        if trial.nats >= best.nats:
            break
        best = trial
    return best
