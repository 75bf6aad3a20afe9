"""What comparing two sets of drives finds: what has changed, by how much, or why these drives do not show it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.display import Card, Displayed, Frame
from avtorch.gap.engine.changes import (
    ChangePosterior,
    Progress,
    candidates,
    scatter_of,
    search_changes,
)
from avtorch.gap.engine.coordinates import adopt
from avtorch.gap.engine.hypothesis import Hypothesis, table_effect
from avtorch.gap.engine.joint import Change as JointChange
from avtorch.gap.engine.joint import JointFit, JointModel, of_car
from avtorch.gap.quantity import Quantity, of_fields, plain, unit_behind, unit_of, words_of
from avtorch.gap.result.hypotheses import LIKELY
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.simulator.effect import Effect

if TYPE_CHECKING:
    import pandas

Answer = Literal["named", "ambiguous", "unknown", "drift", "none"]
SimulatorChange = Literal["closer", "farther", "inconclusive"]

_ERRORS = 4.0  # 2.6 standard errors are as likely as not, and 1.4 more have them in nine of ten drives
_EXCITED = 0.5
"""Share of T_L or K_L, or seconds of dead time, above which drives that show no smaller change excite too little."""
_SURE = 0.9  # from this probability on a part has no alias
_CLOCK_S = 0.02  # offsets between the clocks of two channels, as ordinary recorders have them
_WITHIN = 0.7  # share of the drives after that those before must have covered


@dataclass(frozen=True)
class ChangePart:
    """One thing that has changed: `name` is T_L, K_L or an effect; `parameters` the change itself.

    `alias_set`: what held-out blocks cannot distinguish from it, itself among them. `less`: an effect that the drives
    before have more of.
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Quantity]
    less: bool = False

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        return {"names": [out.pop("name")]} | out

    def __str__(self) -> str:
        name = f"less {self.name}" if self.less else self.name
        sizes = ", ".join(_text(key, q) for key, q in self.parameters.items() if is_change(key))
        return f"{name} ({sizes})" if sizes else name


@dataclass(frozen=True)
class ChangeCause:
    """What has changed: `parts`, the first found first.

    `answer`: `"named"`; `"ambiguous"` where a part has aliases; `"unknown"` where something reproducible has changed
    that no effect explains; `"drift"` where a change is supported, but halves of one side differ by as much; `"none"`,
    also where a change is supported whose size is too uncertain. `detectable`: the least change of T_L and K_L (as a
    share) and of dead time [s] that these drives show, infinite (in JSON null) where they show none. `why`: one or two
    sentences.
    """

    parts: tuple[ChangePart, ...]
    answer: Answer
    detectable: Mapping[str, float]
    why: str

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts)

    @property
    def probability(self) -> float | None:
        """That other drives of the two cars would name the least certain part again; None without parts."""
        return min((part.probability for part in self.parts), default=None)

    def to_dict(self) -> dict[str, Any]:
        each = {f"{part.name}.{key}": q for part in self.parts for key, q in part.parameters.items()}
        return of_fields(self) | {
            "names": list(self.names),
            "alias_set": list(dict.fromkeys(name for part in self.parts for name in part.alias_set)),
            "probability": self.probability,
            "parameters": plain(each),
            "detectable": {name: value if math.isfinite(value) else None for name, value in self.detectable.items()},
        }


@dataclass(frozen=True)
class Change:
    """One number before and after, and the ratio of after to before, each with its central 90 %."""

    before: Quantity
    after: Quantity
    ratio: Quantity


@dataclass(frozen=True, repr=False)
class Comparison(Displayed):
    """`car`: `T_L` [s] and `K_L` fitted to each set of drives; `gap`: rollout errors of the simulator, by metric, over
    `horizon_s` [s]: 10 s, or less where the longest stretch of either set is shorter.

    `changed`: the car's parameters differ, with p-value `p_value` for drives of one car. `simulator`: whether the
    simulator's errors on the drives after are smaller than those on the drives before (each with its own simulator,
    where two are given); `"inconclusive"`: neither. `cause`: what of T_L, K_L, dead time and all effects differs; None
    where both sides are one drive, or differ in their rates.
    """

    before: LogFacts
    after: LogFacts
    car: Mapping[str, Change]
    gap: Mapping[str, Change]
    p_value: float
    changed: bool
    simulator: SimulatorChange
    why: str
    cause: ChangeCause | None = None
    horizon_s: float = 10.0

    def overview(self) -> Card:
        """What has changed, in a sentence or two, and what was measured before and after."""
        answer = "the car has changed" if self.changed else "no change of T_L and K_L is detected"
        table = {name: values for name, values in self.summary().columns.items() if name != "sd"}
        return Card(
            f"Comparison of two sets of drives: {answer} (p = {self.p_value:.2g})", (self.why,), Frame(table), 9
        )

    def summary(self) -> Frame:
        """A row a parameter or error and `side`: before, after, and their ratio; mean, sd, 5 and 95 % quantiles."""
        rows: list[dict[str, object]] = []
        for name, moved in (*self.car.items(), *self.gap.items()):
            unit = {"rollout_rmse_accel": "m/s²", "rollout_rmse_speed": "m/s"}.get(name) or unit_of(name)
            for side, q in (("before", moved.before), ("after", moved.after), ("ratio", moved.ratio)):
                rows.append({"parameter": name, "side": side, "unit": "-" if side == "ratio" else unit, **q.to_dict()})
        return Frame.of_rows(rows)

    def to_dataframe(self) -> pandas.DataFrame:
        """`summary` as a data frame. Needs ``pip install 'avtorch[pandas]'``."""
        return self.summary().to_dataframe()

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json`, schema `avtorch.comparison/1`."""
        return {"schema": "avtorch.comparison/1"} | of_fields(self)


def detectable_text(name: str, value: float) -> str:
    """A least change with its unit: a share of T_L and K_L, seconds of dead time."""
    if not math.isfinite(value):
        return "none"
    if name not in ("T_L", "K_L"):
        return f"{value:.2g} s"
    return f"{value:.0%}" if value > 0.02 else f"{100 * value:.1g}%"


def is_change(key: str) -> bool:
    """Whether a parameter of a change is its size, not what was before or after it."""
    return not key.startswith(("before", "after"))


def _text(key: str, q: Quantity) -> str:
    word = "" if key.startswith("change") else f"{words_of(key)} "
    return f"{word}{q.mean:+.3g}{unit_behind(key)}, 90 % {q.q05:.3g} to {q.q95:.3g}"


# the cause ------------------------------------------------------------------------------------------------------------
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


def _part(found: ChangePosterior, change: JointChange) -> ChangePart:
    alike = found.siblings.get(change.key, ())
    return ChangePart(
        name=change.name,
        alias_set=tuple(dict.fromkeys((change.name, *(alike if found.probability(change) < _SURE else ())))),
        probability=found.probability(change),
        parameters=_parameters(found, change),
        less=change.less,
    )


def _parameters(found: ChangePosterior, change: JointChange) -> dict[str, Quantity]:
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


def _reported(model: JointModel, fit: JointFit, change: JointChange, x: FloatArray) -> dict[str, float]:
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


def _of_effect(h: Hypothesis, change: JointChange) -> dict[str, float]:
    effect = table_effect(h, change.effect)
    own = {q.name: q for q in effect.parameters}
    out = {}
    for key, value in effect.report(torch.tensor([h["T_L"]], dtype=torch.float64)).items():
        x = torch.as_tensor(value).reshape(-1)
        if len(x) != 1 or not math.isfinite(float(x[0])):
            continue
        size, neutral = float(x[0]), own[key].neutral if key in own else None
        if neutral is not None and math.isinf(neutral) and abs(size) > max(map(abs, own[key].physical)):
            continue  # a limit out of reach
        out[key] = -size if change.less and neutral == 0.0 else size
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
