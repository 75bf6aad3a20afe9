"""The cause of a change between two sets of drives: what differs, by how much, or why these drives do not show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.special import ndtr
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.gap.answer.change import Answer, ChangeCause, ChangePart, detectable_text, is_change
from avtorch.gap.change.change_model import Change, ChangeModel, changes
from avtorch.gap.change.change_selection import ChangeSelection, Progress, Step, select_changes, strength_of
from avtorch.gap.change.detectable import detectable_changes, unlike_drives
from avtorch.gap.change.two_sides import TwoSides
from avtorch.gap.quantity import Quantity, unit_of
from avtorch.gap.simulator.effect import Effect, delay_effect
from avtorch.gap.simulator.plant import GapPlant

_EXCITED = 0.5
"""Share of T_L or K_L, or seconds of dead time, above which drives that show no smaller change excite too little."""
_CLOCK_S = 0.02  # offsets between the clocks of two channels, as ordinary recorders have them


def cause_of_change(
    sides: TwoSides,
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    *,
    progress: Progress | None = None,
) -> ChangeCause:
    """What of `kinds`, of T_L, K_L and dead time, explains how the drives after differ from those before.

    Random effects, and those of one drive alone (a grade, a moment), are left out. `progress(what, done, of)` is called
    at each hypothesis.
    """
    selection = select_changes(sides, base, changes(kinds, base, sides), progress=progress)
    parts = tuple(_part(selection, step) for step in selection.steps[1:])
    detectable = detectable_changes(selection)
    answer: Answer = "named"
    if not parts:
        best = selection.rejected
        drifts = best is not None and best.drift > best.relative_sd
        answer = "drift" if drifts else "unknown" if selection.other > 0 else "none"
    elif any(len(part.alias_set) > 1 for part in parts):
        answer = "ambiguous"
    return ChangeCause(parts, answer, detectable, _why(selection, parts, answer, detectable))


def _part(selection: ChangeSelection, step: Step) -> ChangePart:
    assert step.change is not None
    assert step.gains is not None
    # on other drives the gain would scatter by one standard error, and the change by its own
    errors = min(strength_of(step.gains, selection.sides), step.surplus)
    return ChangePart(
        name=step.change.name,
        alias_set=step.aliases,
        probability=float(ndtr(errors)),
        parameters=_parameters(selection.last, step),
        less=step.change.less,
    )


def _parameters(last: Step, step: Step) -> dict[str, Quantity]:
    """By jackknives over folds and over blocks, and by what comes and goes between the halves of one side."""
    assert step.change is not None
    count = len(last.held.p)
    values = _values(last.fit.model, step.change, np.concatenate([last.fit.p[None], last.held.p]))
    sure = float(student.ppf(0.95, count - 1))
    out: dict[str, Quantity] = {}
    for key, x in values.items():
        sd = float(np.sqrt((count - 1) / count * ((x[1:] - x[1:].mean()) ** 2).sum()))
        if is_change(key):
            sd = float(np.hypot(max(sd, step.relative_sd * abs(x[0])), step.drift * abs(x[0])))
        out[key] = Quantity(float(x[0]), sd, float(x[0] - sure * sd), float(x[0] + sure * sd))
    if step.change.parameter is None:
        return out
    # what both sides share is held near its anchor, so folds alone understate the error of either side's value
    least = max(q.sd for q in out.values())
    return {key: Quantity(q.mean, least, q.mean - sure * least, q.mean + sure * least) for key, q in out.items()}


def _values(model: ChangeModel, change: Change, p: FloatArray) -> dict[str, FloatArray]:
    """What is reported of a change, each (fit,), at vectors `p` (fit, size)."""
    if change.parameter is not None:
        sides = [
            each.values(model.of_side(p, after=after))[change.parameter].numpy()
            for each, after in ((model.before, False), (model.after, True))
        ]
        unit = "" if unit_of(change.parameter) == "-" else f"_{unit_of(change.parameter)}"
        named = {"before": sides[0], "after": sides[1], "change": sides[1] - sides[0]}
        return {key + unit: value for key, value in named.items()}
    own = model.before if change.less else model.after
    plants = own.plant.with_values(own.values(model.of_side(p, after=not change.less)))
    effect = next(e for e in plants.effects if e.name == change.name)
    out = {}
    for key, value in effect.report(torch.as_tensor(plants.T_L)).items():
        x = value.numpy()
        if x.ndim == 1 and len(x) == len(p):
            neutral = next((q.neutral for q in effect.coordinates() if q.name == key), None)
            out[key] = -x if change.less and neutral == 0.0 else x
    return out


def _why(
    selection: ChangeSelection, parts: Sequence[ChangePart], answer: Answer, detectable: Mapping[str, float]
) -> str:
    shown = ", ".join(f"{name} {detectable_text(name, value)}" for name, value in detectable.items())
    if parts:
        clauses = [f"What explains it: {' and '.join(map(str, parts))}"]
        for part in parts:
            others = [name for name in part.alias_set if name != part.name]
            if others:
                clauses.append(f"these drives cannot distinguish {part.name} from {' or '.join(others)}")
        if any(part.name == delay_effect().name and abs(part.parameters["change_s"].mean) < _CLOCK_S for part in parts):
            clauses.append("so small a change of dead time may be the recorder's clock")
        if selection.other > 0:
            clauses.append("something else has changed too, and no known effect explains it")
        return "; ".join([*clauses, *unlike_drives(selection.sides)]) + "."
    best = selection.rejected
    if best is not None and best.change is not None and answer != "unknown":
        doubt = f"the standard error of its size is {best.relative_sd:.0%} of it"
        if answer == "drift":
            doubt = f"halves of one side differ by {best.drift:.0%} of it, so one car may have driven both"
        first = f"No cause is named: {best.change.name} explains the difference best, but {doubt}"
        return "; ".join([first, *unlike_drives(selection.sides)]) + "."
    first = "No change is named"
    if answer == "unknown":
        first = "Something reproducible has changed, and no known effect explains it"
    weak = [name for name, value in detectable.items() if value > _EXCITED]
    reason = f"; the commands excite too little for {', '.join(weak)}" if weak else ""
    return (
        "; ".join([f"{first}{reason}. The least change that would show: {shown}", *unlike_drives(selection.sides)])
        + "."
    )
