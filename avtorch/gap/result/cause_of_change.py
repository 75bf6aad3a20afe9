"""The cause of a change between two sets of drives: what differs, by how much, or why these drives do not show it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.gap.engine.changes import (
    ChangePosterior,
    Progress,
    candidates,
    scatter_of,
    search_changes,
)
from avtorch.gap.engine.coordinates import adopt
from avtorch.gap.engine.hypothesis import Hypothesis, table_effect
from avtorch.gap.engine.joint import Change, JointFit, JointModel, of_car
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import LIKELY
from avtorch.gap.result.comparison import Answer, ChangeCause, ChangePart, detectable_text
from avtorch.gap.simulator.effect import Effect

_ERRORS = 4.0  # 2.6 standard errors are as likely as not, and 1.4 more have them in nine of ten drives
_EXCITED = 0.5
"""Share of T_L or K_L, or seconds of dead time, above which drives that show no smaller change excite too little."""
_SURE = 0.9  # from this probability on a part has no alias
_CLOCK_S = 0.02  # offsets between the clocks of two channels, as ordinary recorders have them
_WITHIN = 0.7  # share of the drives after that those before must have covered


def cause_of_change(
    model: JointModel, kinds: Sequence[type[Effect]], *, progress: Progress | None = None
) -> ChangeCause:
    """What of `kinds`, of T_L, K_L and dead time, explains how the drives after differ from those before.

    Random effects, and those of one drive alone (a grade, a moment), are left out. `progress(what, done, of)` is called
    at each hypothesis.
    """
    names = [adopt(k).name for k in kinds if not (k.random or k.of_the_drive)]
    found = search_changes(model, candidates(model, names), progress)
    parts = tuple(_part(found, change) for change in found.best.fit.changes if not change.shared)
    parts = tuple(part for part in parts if found.probability_of_any(part.alias_set) >= LIKELY)
    detectable = _detectable(model)
    answer: Answer = "named"
    if not parts:
        drifts = found.rejected is not None and _would_enter(found) and found.rejected[1].drifts
        answer = "drift" if drifts else "unknown" if found.unknown >= LIKELY else "none"
    elif any(len(part.alias_set) > 1 for part in parts):
        answer = "ambiguous"
    return ChangeCause(parts, answer, detectable, _why(found, parts, answer, detectable))


def _would_enter(found: ChangePosterior) -> bool:
    """Whether the change that was rejected had entered if halves and blocks agreed."""
    return found.rejected is not None and found.rejected[2] > 0


def _part(found: ChangePosterior, change: Change) -> ChangePart:
    alike = found.siblings.get(change.key, ())
    return ChangePart(
        name=change.name,
        alias_set=tuple(dict.fromkeys((change.name, *(alike if found.probability(change) < _SURE else ())))),
        probability=found.probability(change),
        parameters=_parameters(found, change),
        less=change.less,
    )


def _parameters(found: ChangePosterior, change: Change) -> dict[str, Quantity]:
    """By blocks of both sides, and by what comes and goes between the halves of one."""
    fit, model = found.best.fit, found.model
    likelihood, blocks, drift = model.covariance(fit)
    blocks = blocks + 1e-9 * np.diag(np.diag(likelihood))  # also of what stands at a limit
    at = fit.at(change)
    sure = float(student.ppf(0.95, model.blocks - 1))  # blocks of the shorter side
    spread = blocks * np.sqrt(np.outer(*2 * [np.maximum(np.diag(likelihood) / np.diag(blocks), 1.0)]))
    spread[at, at] += drift[at]
    here = _reported(model, fit, change, fit.x)
    step = np.maximum(1e-3 * np.sqrt(np.diag(spread)), 1e-6)
    slopes: dict[str, list[float]] = {key: [] for key in here}
    for k in range(len(fit.x)):
        x = fit.x.copy()
        x[k] += step[k]
        moved = _reported(model, fit, change, x)
        for key, value in here.items():  # a limit out of reach has no size
            slopes[key].append((moved.get(key, value) - value) / step[k])
    sds = {key: math.sqrt(max(float(np.array(s) @ spread @ np.array(s)), 0.0)) for key, s in slopes.items()}
    return {key: Quantity(x, sds[key], x - sure * sds[key], x + sure * sds[key]) for key, x in here.items()}


def _reported(model: JointModel, fit: JointFit, change: Change, x: FloatArray) -> dict[str, float]:
    """What is reported of a change at `x` (coordinate,): before, after and change of T_L, K_L or the dead time, or the
    effect's parameters."""
    before, after = (model.hypothesis(fit.changes, fit.coordinates, x, side) for side in (False, True))
    if not change.effect:
        unit = {"T_L": "_s", "dead_time": "_s"}.get(change.name, "")
        a, b = before[change.name], after[change.name]
        return {f"before{unit}": a, f"after{unit}": b, f"change{unit}": b - a}
    if change.grows:
        old, new = _of_effect(before, change), _of_effect(after, change)
        neutral = {q.name for q in table_effect(after, change.effect).parameters if q.neutral == 0.0}
        return {key: value - old[key] if key in neutral else value for key, value in new.items() if key in old}
    return _of_effect(before if change.less else after, change)


def _of_effect(h: Hypothesis, change: Change) -> dict[str, float]:
    effect = table_effect(h, change.effect)
    own = {q.name: q for q in effect.parameters}
    out = {}
    for key, value in effect.report(torch.tensor([h["T_L"]], dtype=torch.float64)).items():
        x, q = torch.as_tensor(value).reshape(-1), own.get(key)
        if len(x) != 1 or not math.isfinite(float(x[0])):
            continue
        if (
            q is not None
            and q.neutral is not None
            and math.isinf(q.neutral)
            and abs(float(x[0])) > max(map(abs, q.physical))
        ):
            continue  # a limit out of reach
        out[key] = -float(x[0]) if change.less and q is not None and q.neutral == 0.0 else float(x[0])
    return out


def _detectable(model: JointModel) -> dict[str, float]:
    """The least change of T_L and K_L (share) and of dead time [s] that would show in nine of ten such drives.

    It is the change of one, nothing else changing: 4 standard errors, by the likelihood or by blocks.
    """
    out = {}
    for name in ("T_L", "K_L", *(["dead_time"] if "dead_time" in model.base.effects else [])):
        change = of_car(name)
        fit = model.evaluated(model.at((change,), np.append(model.start.x, 0.0)))
        scatter = scatter_of(model, fit, change)
        error = math.sqrt(max(scatter.blocks, scatter.likelihood))
        out[name] = _ERRORS * error if any(d[-1].any() for d in fit.derivatives) else math.inf
    return out


def unlike_drives(model: JointModel) -> list[str]:
    """What the drives after do that those before did not: a clause for each of command and speed."""
    out = []
    for name, key in (("commands", "command"), ("speeds", "speed")):
        before, after = (getattr(side, key) for side in model.sides)
        if before is None or after is None:
            continue
        low, high = np.quantile(before, (0.01, 0.99))
        share = float(((after >= low) & (after <= high)).mean())
        if share < _WITHIN:
            out.append(
                f"only {share:.0%} of the drives after are at {name} that those before cover, so what the car does "
                "there may be no change"
            )
    return out


def _why(found: ChangePosterior, parts: Sequence[ChangePart], answer: Answer, detectable: Mapping[str, float]) -> str:
    shown = ", ".join(f"{name} {detectable_text(name, value)}" for name, value in detectable.items())
    unlike = unlike_drives(found.model)
    if parts:
        clauses = [f"What explains it: {' and '.join(map(str, parts))}"]
        for part in parts:
            others = [name for name in part.alias_set if name != part.name]
            if others:
                clauses.append(f"these drives cannot distinguish {part.name} from {' or '.join(others)}")
        if any(part.name == "dead_time" and abs(part.parameters["change_s"].mean) < _CLOCK_S for part in parts):
            clauses.append("so small a change of dead time may be the recorder's clock")
        if found.unknown >= LIKELY:
            clauses.append("something else has changed too, and no known effect explains it")
        return "; ".join([*clauses, *unlike]) + "."
    if found.rejected is not None and answer != "unknown" and _would_enter(found):
        doubt = "its blocks disagree on how large it is"
        if answer == "drift":
            doubt = "halves of one side differ as much, so one car may have driven both"
        first = f"No cause is named: {found.rejected[0].names[-1]} explains the difference best, but {doubt}"
        return "; ".join([first, *unlike]) + "."
    first = "No change is named"
    if answer == "unknown":
        first = "Something reproducible has changed, and no known effect explains it"
    weak = [name for name, value in detectable.items() if value > _EXCITED]
    reason = f"; the commands excite too little for {', '.join(weak)}" if weak else ""
    return "; ".join([f"{first}{reason}. The least change that would show: {shown}", *unlike]) + "."
