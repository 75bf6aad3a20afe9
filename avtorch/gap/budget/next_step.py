"""The effect that enters a model next, unless a checkpoint has the step already.

Nearly all of a selection's time goes here: for each step some twenty effects are screened, nine fitted and five held
out. What was found is stored by everything that it depends on, so that a selection that was killed goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from avtorch.errors import InputError
from avtorch.gap.budget.entry import LEAST_NATS, candidates_for, enter
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Step
from avtorch.gap.search.checkpoint import REMEDY, Checkpoint, StoredStep
from avtorch.gap.simulator.effect import Effect
from avtorch.io import fingerprint


def next_step(
    fitting: RobustFit,
    now: Step,
    kinds: Sequence[type[Effect]],
    progress: Callable[[str, int, int], None] | None,
    role: str,
    checkpoint: Checkpoint | None = None,
    *,
    least: float = LEAST_NATS,
) -> Step | None:
    """`now` with the best of `kinds` that it lacks, if the blocks that were held out agree on one.

    `least`: nats that it has to gain in the blocks that fit it.

    Raises `InputError` for a `checkpoint` whose step is of another model.
    """
    inputs = None
    if checkpoint is not None and checkpoint.path is not None:
        model = now.fit.model
        inputs = fingerprint(model.names, sorted(model.onsets.items()), now.fit.z, [kind.name for kind in kinds])
        kept = checkpoint.step(inputs)
        if kept is not None:
            return _restored(fitting, now, kinds, kept, checkpoint)
    # what was kept of other fits' slopes would make a step depend on the way to it
    fitting.forget()
    step = enter(fitting, now, candidates_for(fitting, now, kinds, progress, role), least)
    fitting.forget()
    if step is not None and step.fit.model.roads:
        step = _held_out(fitting, now, step.fit, step.aliases)
    if checkpoint is not None and inputs is not None:
        checkpoint.keep_step(inputs, _stored(step))
    return step


def _held_out(fitting: RobustFit, now: Step, fit: Fit, aliases: tuple[str, ...]) -> Step:
    held = fitting.hold_out(fit)
    return Step(fit, held, fit.model.names[-1], fitting.evidence(now.held, held), aliases)


def _stored(step: Step | None) -> StoredStep:
    if step is None:
        return StoredStep()
    fit = step.fit
    return StoredStep(fit.model.names, fit.model.onsets, fit.z, fit.nats, fit.block_nats, step.aliases)


def _restored(
    fitting: RobustFit, now: Step, kinds: Sequence[type[Effect]], kept: StoredStep, checkpoint: Checkpoint
) -> Step | None:
    """The step of a file."""
    if not kept.effects:
        return None
    entered = next((kind for kind in kinds if kind.name == kept.effects[-1]), None)
    if entered is not None and kept.effects[:-1] == now.fit.model.names:
        model = replace(now.fit.model.with_effect(entered), onsets=dict(kept.onsets))
        if len(kept.z) == model.size and len(kept.block_nats) == len(now.fit.block_nats):
            fitting.forget()
            return _held_out(fitting, now, Fit(model, kept.z, kept.nats, kept.block_nats), kept.aliases)
    raise InputError(f"{checkpoint.path}: a step of the budget does not match its recorded start; {REMEDY}")
