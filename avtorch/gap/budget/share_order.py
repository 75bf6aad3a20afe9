"""Which of the selected effects are parts of the gap, in the order of what they take off it.

Effects that act together have no shares of their own: a resistance and a gain that falls with speed may each make
rollouts worse and both together explain them. So an effect is left out only if the others do without it, and those that
reduce the error only together share what they take off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.optimize import isotonic_regression

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import MATERIAL
from avtorch.gap.budget.flexible_regression import predicted_residuals
from avtorch.gap.budget.rollout_energy import (
    calm_blocks,
    counted_rows,
    held_out_residuals,
    relative_energy,
    rollout_squares,
)
from avtorch.gap.budget.selection_step import Selection, Step, without_effects

_OF_THE_RESPONSE = 3.0  # times as large a share of the response, which counts beside the gap
_LEAST_GAP = 0.1  # of the floor's energy, that there is a gap
_DRAWS = 2000


def largest_first(selection: Selection, material: float = MATERIAL, *, seed: int = 0) -> Selection:
    """The selection's effects in the order of what each takes off the energy on top of those before it.

    One without which the others leave no more than `material` of the energy is left out: a delay of ten milliseconds
    may be certain, and is no part of a gap. Unless three times as much of the response is its own: slow noise, and
    beside it a large force, may leave little else to see in errors of rollouts, and a lag that is fitted anew hides
    most of a dead time, which a controller feels all the same. With `material` 0 none is left out.
    """
    bare = selection.steps[0]
    entered = {str(s.entered): s for s in selection.steps[1:]}
    now, without = selection.last, _without_each(selection, selection.last)
    gap = not material or gap_is_there(energies(selection, seed)[-1])
    least = material * relative_energy(selection, bare)
    while material and without:
        here = relative_energy(selection, now)
        costs = {name: relative_energy(selection, step) - here for name, step in without.items()}
        idle = [name for name, cost in costs.items() if not (gap and cost >= least)]
        idle = [name for name in idle if own_response(now, name) < _OF_THE_RESPONSE * material]
        if not idle:
            break
        now = without[min(idle, key=lambda name: costs[name])]
        now = replace(now, held=selection.fitting.hold_out(now.fit))
        without = _without_each(selection, now)
    steps: list[Step] = []
    bare_energy = relative_energy(selection, bare)
    while without:
        # of those that reduce the error only together, the one that makes the least of the response goes
        left = {name: min(relative_energy(selection, step), bare_energy) for name, step in without.items()}
        name = min(left, key=lambda name: (left[name], own_response(now, name)))
        steps.append(replace(entered[name], fit=now.fit, held=now.held))
        now = without[name]
        without = _without_each(selection, now)
    return replace(selection, steps=(bare, *reversed(steps)))


def _without_each(selection: Selection, step: Step) -> Mapping[str, Step]:
    """The model of `step` without each of its effects in turn."""
    found = {}
    for name in step.fit.model.names:
        fit = without_effects(selection.fitting, step.fit, [name])
        found[name] = Step(fit, selection.fitting.hold_out(fit, iterations=1))
    return found


def own_response(step: Step, name: str) -> float:
    """Share of the response (root mean square) that an effect makes, all else equal; of the channel with the most."""
    model = step.fit.model
    rest = model.without(name)
    whole, without = model.simulate(step.fit.z), rest.simulate(rest.coordinates(step.fit.known))
    rows = model.record.counts
    size = np.sqrt((whole[:, rows] ** 2).mean(-1)) + 1e-12
    return float((np.sqrt(((whole - without)[:, rows] ** 2).mean(-1)) / size).max())


def energies(selection: Selection, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean squared errors of rollouts (model, draw, channel), their floors (channel,), and energies (model, draw).

    Models are the selection's steps, and last the floor's; draws of blocks, the first of which is all of them once.
    """
    fitting = selection.fitting
    held = [held_out_residuals(selection, step) for step in selection.steps]
    floor = held[-1] - predicted_residuals(fitting, selection.last.fit, held[-1])
    errors = np.stack([rollout_squares(selection, x) for x in [*held, floor]])  # (model, channel, block)
    calm = calm_blocks(selection)
    blocks = len(calm)
    draws = np.random.default_rng(seed).multinomial(blocks, np.ones(blocks) / blocks, _DRAWS)
    weights = np.concatenate([np.ones((1, blocks)), draws]) * counted_rows(selection)[calm]
    means = np.einsum("db,mcb->mdc", weights, errors[..., calm]) / weights.sum(-1)[:, None]
    floors = np.minimum(means[-1, 0], means[-2, 0])
    return means, floors, (means / floors).mean(-1)


def gap_is_there(energy: FloatArray) -> bool:
    """Whether there is one in `energy` (model, draw): drives drawn anew have it too, and it is no small part of the
    noise."""
    whole = energy[0] - np.minimum(energy[-1], energy[-2])
    return bool(whole[0] > _LEAST_GAP and np.quantile(whole[1:], 0.05) > 0)


def taken_off(energy: FloatArray) -> FloatArray:
    """What each effect takes off `energy` (1 + effect, draw), (effect, draw).

    Where an effect takes less than one behind it the two took it together, and each counts for the mean (antitonic
    regression over all blocks, the same groups in every draw). An effect that is sure and changes the response,
    but drowns in what slow noise does to rollouts, takes nothing.
    """
    taken = energy[:-1] - energy[1:]
    together = isotonic_regression(taken[:, 0], increasing=False).blocks
    for begin, end in pairwise(together):
        taken[begin:end] = taken[begin:end].mean(0)
    return np.maximum(taken, 0.0)
