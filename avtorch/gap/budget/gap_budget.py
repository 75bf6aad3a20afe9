"""The budget: of the gap in held-out rollouts, what each cause takes off, what is left, what is noise.

An energy is the mean squared error of rollouts over 10 s, each channel over its own floor, the mean of the channels.
Every block's error is that of a model fitted without it. The floor is what no model that knows commands, speed and
time could predict: what a regression on these leaves of held-out blocks, once the causes are in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.gap.answer.budget import MATERIAL, Budget, ChancePart, ChannelError, Part, Unexplained, own_onset
from avtorch.gap.answer.plausibility import implausible
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.forward_selection import select
from avtorch.gap.budget.likely_parts import likely_parts, probabilities
from avtorch.gap.budget.one_channel import with_untested
from avtorch.gap.budget.repaired_model import lag_and_gain, parameters_of
from avtorch.gap.budget.rollout_energy import horizon
from avtorch.gap.budget.selection_step import Selection, Step
from avtorch.gap.budget.share_order import energies, gap_is_there, taken_off
from avtorch.gap.budget.slow_disturbance import slow_disturbance
from avtorch.gap.budget.unexplained_places import placed
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.effect_choice import chosen_effects
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import Log

_SURELY = 0.95  # share of the draws that find more unexplained than is material


@shows_progress
def gap_budget(
    logs: Log | Sequence[Log],
    *,
    baseline: GapPlant | str | PathLike[str] | None = None,
    effects: Sequence[str | type[Effect]] | None = None,
    material: float = MATERIAL,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | bool | None = None,
) -> Budget:
    """The budget of the gap between `baseline` (default: bare GLVD) and the car of these drives.

    Args: `effects`: candidates by name or class (default: all registered); of the random ones, which predict nothing,
    only a slow force is looked for. `material`: share of the bare baseline's squared error, or three times as much of
    the response, below which a cause is not a part; and share of the gap from which what is unexplained is material.
    `seed`: of the drawing of blocks for the intervals. `progress(what, done, of)` is called at each effect tried; or
    True, False, None, as in `avtorch.diagnose`.

    Raises `InputError` for a log without `accel_cmd`, for logs with less than six seconds that count (blocks
    are then of one second; six of four seconds or more are better), or for wrong arguments.

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
    kinds = chosen_effects(effects)
    selection = select(AnalysisRecord.for_budget(each), base, kinds, progress=called(progress))
    selection = likely_parts(selection, material, seed=seed)
    budget = budget_of(selection, material=material, seed=seed, epoch_s=each[0].epoch_s)
    rest = placed(budget.unexplained, selection, epoch_s=each[0].epoch_s)
    budget = replace(budget, unexplained=rest, chance=by_chance(selection, base, kinds))
    return with_untested(budget, selection, each, kinds)


def by_chance(selection: Selection, base: GapPlant, kinds: Sequence[type[Effect]]) -> tuple[ChancePart, ...]:
    """Those of `kinds` that are random forces `base` lacks, as far as the residuals hold one."""
    present = {e.name for e in base.effects}
    random = [k for k in kinds if k.own_search() == "force" and k.name not in present]
    if not random:
        return ()
    fitting, fit = selection.fitting, selection.last.fit
    noise, record = left_over(fitting, fit), fitting.whitening.record
    T_L, bare = (float(f.model.values(f.z)["T_L"]) for f in (fit, selection.steps[0].fit))
    found = [(kind, slow_disturbance(record, noise, T_L, kind, bare_lag=bare)) for kind in random]
    along = [k.name for k in kinds if issubclass(k, Integrated) and k.name not in {*present, *fit.model.names}]
    return tuple(
        replace(part, alias_set=tuple(along)) if _within_a_knot(record, kind, part) else part
        for kind, part in found
        if part is not None
    )


def _within_a_knot(record: AnalysisRecord, kind: type[Effect], force: ChancePart) -> bool:
    """Whether a slow `force` could as well belong to places: each is passed once, and it changes between two knots."""
    if not record.has_speed or len(set(record.log)) > 1:
        return False
    lasts = (force.parameters or {})[kind.noise_parameters["force_time"]].mean
    return lasts * float(np.abs(record.speed[record.counts]).mean()) < record.knot_m


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
    means, floors, energy = energies(selection, seed)
    there = gap_is_there(energy)
    taken = taken_off(energy[:-1])
    rest = np.maximum(energy[-2] - energy[-1], 0.0)
    total = np.maximum(taken.sum(0) + rest, 1e-12)
    shares = taken / total
    unexplained = np.maximum(1.0 - shares.sum(0), 0.0)
    sure = probabilities(selection)
    parts = tuple(
        _part(selection, step, sure, _quantity(share), float(np.sqrt(energy[number + 1, 0])), epoch_s)
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


def _part(
    selection: Selection, step: Step, sure: Mapping[str, float], share: Quantity, after: float, epoch_s: float
) -> Part:
    assert step.entered is not None
    model = selection.last.fit.model
    parameters = parameters_of(selection, step.entered)
    kind = next(e for e in model.effects if e.name == step.entered)
    onset = model.onsets.get(step.entered)
    several = len(set(model.record.log)) > 1
    since = own_onset(kind, parameters, None if several else epoch_s) if onset is None else onset + epoch_s
    always = set(kind.alike({key: q.mean for key, q in parameters.items()})) - set(model.names)
    return Part(
        name=step.entered,
        alias_set=tuple(sorted({*step.aliases, *always})),
        probability=sure[step.entered],
        share=share,
        after=after,
        parameters=parameters,
        onset_s=since,
        plausible=not implausible(parameters, {}, [kind]),
    )


def _quantity(draws: FloatArray) -> Quantity:
    """Of what all blocks once, then draws of them, say."""
    q05, q95 = np.quantile(draws[1:], (0.05, 0.95))
    mean = float(draws[0])
    return Quantity(mean, float(draws[1:].std()), min(float(q05), mean), max(float(q95), mean))
