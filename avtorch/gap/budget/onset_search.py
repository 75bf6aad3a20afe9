"""Since when an effect acts: the row from which the model with it is better than the model without.

A model's response switches from one to the other at the onset, so for given parameters two simulations price every row.
From the best one the parameters are fitted anew, by turns. A score test cannot do that: it knows the response near the
fit without the effect, whose lag and gain make up for as much of it as they can. Where turns end, onset and parameters
may be wrong together, and a step of all of them is tried (`onset_step`).
"""

from __future__ import annotations

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.budget.onset_step import onset_by_step
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
    responses = [model.simulate(model.coordinates(fit.known)) for model in (never, always)]
    without, with_it = (whitening(record.measured - response) for response in responses)
    now = fitting.white(fit.model, fit.z) if name in fit.model.onsets else with_it
    weight = 0.5 * fitting.weights(now, np.ones(whitening.blocks))
    by_time = np.argsort(whitening.order, kind="stable")
    gain = (weight * (without**2 - with_it**2).sum(0))[by_time]
    # what acting from each row on gains over never
    later = np.cumsum(gain[::-1])[::-1]
    best = whitening.order[by_time][int(np.argmax(np.where(inner[by_time], later, -np.inf)))]
    change = responses[0] - responses[1]
    rows, costs = _exactly(fitting, change, without, with_it, weight, near=best, among=np.sort(whitening.order[inner]))
    number = int(np.argmin(costs))
    return float(record.time[rows[number]]), float((weight * (now**2).sum(0)).sum()) - float(costs[number])


def _exactly(
    fitting: RobustFit,
    change: FloatArray,
    without: FloatArray,
    with_it: FloatArray,
    weight: FloatArray,
    *,
    near: int,
    among: IntArray,
) -> tuple[IntArray, FloatArray]:
    """The rows `among` those within `_NEAR_S` of the row `near`, and what the residuals cost with an onset at each.

    `change` (channel, row) [m/s²] of the residuals by the effect, `without` and `with_it` (channel, counted) white.
    Where noise wanders, what sets in shows by its first row most of all: the filter has to see the response switch.
    """
    whitening = fitting.whitening
    record, order = whitening.record, whitening.order
    stretch = next(s.rows for s in record.stretches if s.rows.start <= near < s.rows.stop)
    reach = round(_NEAR_S / record.dt)
    rows = among[(np.abs(among - near) <= reach) & (among >= stretch.start) & (among < stretch.stop)]
    begin, end = int(rows[0]), min(int(rows[-1]) + whitening.taps.shape[1], stretch.stop)
    switched = np.where(np.arange(begin, end) >= rows[:, None, None], change[:, begin:end], 0.0)
    inside = (order >= begin) & (order < end)
    white = without[:, inside] + whitening.since(switched)[..., order[inside] - begin]
    outside = np.where(order < begin, without, with_it)[:, ~inside]
    rest = float((weight[~inside] * outside**2).sum())
    return rows, rest + (weight[inside] * white**2).sum((-2, -1))


def set_in(fitting: RobustFit, fit: Fit, name: str, *, turns: int = _TURNS, iterations: int = _ITERATIONS) -> Fit:
    """The fit with the effect `name` acting from the onset on that fits best, found by turns; `fit` where none does.

    Where no row is better for the parameters as they are, one is sought for which all of them give way.
    """
    best = fit
    for _ in range(turns):
        trial = _of_rows(fitting, best, name, iterations) or _of_steps(fitting, best, name, iterations)
        if trial is None:
            break
        best = trial
    return best


def _of_rows(fitting: RobustFit, best: Fit, name: str, iterations: int) -> Fit | None:
    """A better fit than `best`, from the best row for its parameters."""
    found = best_onset(fitting, best, name)
    if found is None or found[1] < _LEAST_NATS:
        return None
    model = best.model.setting_in(name, found[0])
    trial = fitting.fit(model, model.coordinates(best.known)[None], iterations=iterations)
    return trial if trial.nats < best.nats else None


def _of_steps(fitting: RobustFit, best: Fit, name: str, iterations: int) -> Fit | None:
    """A better fit than `best`, from the onset at which a step of all parameters promises most."""
    found = onset_by_step(fitting, best, name)
    if found is None or found.promises < _LEAST_NATS:
        return None
    trial = fitting.fit(found.model, found.z[None], iterations=iterations)
    return trial if trial.nats < best.nats - _LEAST_NATS else None
