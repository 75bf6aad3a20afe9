"""The budget: of the gap in held-out rollouts, what each cause takes off, what is left, what is noise.

An energy is the mean squared error of rollouts over 10 s, each channel over its own floor, the mean of the channels.
Every block's error is that of a model fitted without it. The floor is what no model that knows commands, speed and
time could predict: what a regression on these leaves of held-out blocks, once the causes are in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike

import numpy as np
from scipy.special import ndtr

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.flexible_regression import left_over, predicted_residuals
from avtorch.gap.budget.forward_selection import (
    Selection,
    Step,
    select,
    without_effects,
)
from avtorch.gap.budget.parts import MATERIAL, Budget, ChancePart, ChannelError, Part, Unexplained
from avtorch.gap.budget.repaired_model import lag_and_gain, parameters_of
from avtorch.gap.budget.rollout_energy import (
    calm_blocks,
    counted_rows,
    held_out_residuals,
    horizon,
    relative_energy,
    rollout_squares,
)
from avtorch.gap.budget.slow_disturbance import slow_disturbance
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import EFFECTS, Effect, effect_class
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log

_OF_THE_RESPONSE = 3.0  # times as large a share of the response, which counts beside the gap
_LEAST_GAP = 0.1  # of the floor's energy, that there is a gap
_DRAWS = 2000
_SURELY = 0.95  # share of the draws that find more unexplained than is material


def gap_budget(
    logs: Log | Sequence[Log],
    *,
    baseline: GapPlant | str | PathLike[str] | None = None,
    effects: Sequence[str | type[Effect]] | None = None,
    material: float = MATERIAL,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> Budget:
    """The budget of the gap between `baseline` (default: bare GLVD) and the car of these drives.

    Args: `effects`: candidates by name or class (default: all registered); of the random ones, which predict nothing,
    only a slow force is looked for. `material`: share of the gap, or of the response, below which a cause is not a
    part. `seed`: of the drawing of blocks for the intervals. `progress(what, done, of)` is called at each effect tried.

    Raises `InputError` for a log without `accel_cmd`, for logs with less than six blocks of four seconds that count,
    or for wrong arguments.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from avtorch.gap import ConstantResistance, gap_budget, plant
        >>> dragging = plant([ConstantResistance(0.2)], sigma=0.02)
        >>> log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=dragging).log()
        >>> gap_budget(log, effects=["constant_resistance", "dead_time"]).names
        ('constant_resistance',)
    """
    each = [logs] if isinstance(logs, Log) else list(logs)
    if not 0 < material < 1:
        raise InputError(f"material: found {material}, needs a share between 0 and 1")
    base = baseline if isinstance(baseline, GapPlant) else plant([], baseline=baseline)
    kinds = [e if isinstance(e, type) else effect_class(e) for e in (EFFECTS.values() if effects is None else effects)]
    selection = select(AnalysisRecord.of(each), base, kinds, progress=progress)
    selection = largest_first(selection, material, seed=seed)
    budget = budget_of(selection, material=material, seed=seed, epoch_s=each[0].epoch_s)
    return replace(budget, chance=by_chance(selection, base, kinds))


def by_chance(selection: Selection, base: GapPlant, kinds: Sequence[type[Effect]]) -> tuple[ChancePart, ...]:
    """Those of `kinds` that are random forces `base` lacks, as far as the residuals hold one."""
    present = {e.name for e in base.effects}
    random = [k for k in kinds if k.own_search() == "force" and k.name not in present]
    if not random:
        return ()
    fitting, fit = selection.fitting, selection.last.fit
    noise, T_L = left_over(fitting, fit), float(fit.model.values(fit.z)["T_L"])
    found = [slow_disturbance(fitting.whitening.record, noise, T_L, kind) for kind in random]
    return tuple(part for part in found if part is not None)


def largest_first(selection: Selection, material: float = MATERIAL, *, seed: int = 0) -> Selection:
    """The selection's effects in the order of what each takes off the energy on top of those before it.

    One that takes less than `material` off is left out: a delay of ten milliseconds may be certain, and is no part of a
    gap. Unless it changes the response by three times as much: slow noise, and beside it a large force, may leave
    little else to see in errors of rollouts. With `material` 0 none is left out.
    """
    fitting, bare, last = selection.fitting, selection.steps[0], selection.last
    entered = {s.entered: s for s in selection.steps[1:]}
    steps, rest = [bare], list(last.fit.model.names)
    gap = not material or _gap_is_there(_energies(selection, seed)[-1])
    while rest:
        tried = []
        for name in rest:
            fit = without_effects(fitting, last.fit, [other for other in rest if other != name])
            held = last.held if fit is last.fit else fitting.hold_out(fit, iterations=1)
            tried.append(replace(entered[name], fit=fit, held=held))
        energies = [relative_energy(selection, step) for step in tried]
        best = tried[int(np.argmin(energies))]
        before, after = relative_energy(selection, steps[-1]), float(np.min(energies))
        name = str(best.entered)
        worth = gap and (before - after >= material * relative_energy(selection, bare) or not material)
        if not worth and _change(steps[-1], best) < _OF_THE_RESPONSE * material:
            last = Step(without_effects(fitting, last.fit, [name]), last.held)
            last = replace(last, held=fitting.hold_out(last.fit))
        else:
            steps.append(best)
        rest.remove(name)
    return Selection(fitting, tuple(steps))


def _change(before: Step, after: Step) -> float:
    """Share of the response (root mean square) that one more effect changes; of the channel that it changes most."""
    one, other = before.fit.model.simulate(before.fit.z), after.fit.model.simulate(after.fit.z)
    rows = after.fit.model.record.counts
    size = np.sqrt((other[:, rows] ** 2).mean(-1)) + 1e-12
    return float((np.sqrt(((other - one)[:, rows] ** 2).mean(-1)) / size).max())


def budget_of(
    selection: Selection,
    *,
    material: float = MATERIAL,
    seed: int = 0,
    epoch_s: float = 0.0,
) -> Budget:
    """The budget of a selection, as it is ordered; intervals of shares by drawing blocks anew.

    `epoch_s`: the first log's start on its own clock.
    """
    record = selection.fitting.whitening.record
    means, floors, energy = _energies(selection, seed)
    there = _gap_is_there(energy)
    # a part may be sure and change the response, and drown in what slow noise does to rollouts: its share is small then
    taken = np.maximum(energy[:-2] - energy[1:-1], 0.0)
    rest = np.maximum(energy[-2] - energy[-1], 0.0)
    total = np.maximum(taken.sum(0) + rest, 1e-12)
    shares = taken / total
    unexplained = 1.0 - shares.sum(0)
    parts = tuple(
        _part(selection, step, _quantity(share), float(np.sqrt(energy[number + 1, 0])), epoch_s)
        for number, (step, share) in enumerate(zip(selection.steps[1:], shares, strict=False))
    )
    likely = float((unexplained[1:] > material).mean()) if there else 0.0
    bare = selection.steps[0].fit
    return Budget(
        before=float(np.sqrt(energy[0, 0])),
        left=float(np.sqrt(energy[-2, 0])),
        by_channel={
            name: ChannelError(*(float(np.sqrt(x[c])) for x in (means[0, 0], floors, means[-2, 0])))
            for c, name in enumerate(record.channels)
        },
        parts=parts,
        unexplained=Unexplained(_quantity(unexplained), likely > _SURELY, likely),
        baseline={key: float(value) for key, value in bare.model.values(bare.z).items() if key in ("T_L", "K_L")},
        repaired=lag_and_gain(selection),
        material=material,
        horizon_s=horizon(record),
    )


def _energies(selection: Selection, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
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


def _gap_is_there(energy: FloatArray) -> bool:
    """Whether there is one in `energy` (model, draw): drives drawn anew have it too, and it is no small part of the
    noise."""
    whole = energy[0] - np.minimum(energy[-1], energy[-2])
    return bool(whole[0] > _LEAST_GAP and np.quantile(whole[1:], 0.05) > 0)


def _part(selection: Selection, step: Step, share: Quantity, after: float, epoch_s: float) -> Part:
    assert step.entered is not None
    model, z = selection.last.fit.model, selection.last.fit.z
    onset = model.onsets.get(step.entered)
    return Part(
        name=step.entered,
        alias_set=step.aliases,
        # on another drive its gain would scatter by one standard error
        probability=float(ndtr(step.strength)),
        share=share,
        after=after,
        parameters=parameters_of(selection, step.entered),
        onset_s=None if onset is None else onset + epoch_s,
        plausible=model.plausible(z, step.entered),
    )


def _quantity(draws: FloatArray) -> Quantity:
    """Of what all blocks once, then draws of them, say."""
    q05, q95 = np.quantile(draws[1:], (0.05, 0.95))
    mean = float(draws[0])
    return Quantity(mean, float(draws[1:].std()), min(float(q05), mean), max(float(q95), mean))
