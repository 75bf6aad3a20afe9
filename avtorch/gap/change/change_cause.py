"""The cause of a change between two sets of drives: what differs, by how much, or why these drives do not show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal

import numpy as np
import torch
from scipy.special import ndtr
from scipy.stats import t as student

from avtorch.arrays import FloatArray
from avtorch.gap.change.change_model import Change, ChangeModel, changes
from avtorch.gap.change.change_selection import ChangeSelection, Progress, Step, select_changes, strength_of
from avtorch.gap.change.detectable import detectable_changes, unlike_drives
from avtorch.gap.change.two_sides import TwoSides
from avtorch.gap.quantity import Quantity, unit_of, words_of
from avtorch.gap.simulator.effect import Effect, delay_effect
from avtorch.gap.simulator.plant import GapPlant

Answer = Literal["named", "ambiguous", "unknown", "drift", "none"]
_EXCITED = 0.5
"""Share of T_L or K_L, or seconds of dead time, above which drives that show no smaller change excite too little."""
_CLOCK_S = 0.02  # offsets between the clocks of two channels, as ordinary recorders have them


@dataclass(frozen=True)
class ChangePart:
    """One thing that has changed: `name` is T_L, K_L or an effect; `parameters` the change itself.

    `alias_set`: what held-out blocks cannot distinguish from it, itself among them. `less`: an effect that the drives
    before have more of.

    Example:
        >>> from avtorch.gap.change.change_cause import ChangePart
        >>> from avtorch.gap.quantity import Quantity
        >>> part = ChangePart("K_L", ("K_L",), 0.99, {"change": Quantity(-0.1, 0.01, -0.12, -0.08)})
        >>> part.to_dict()["parameters"]["change"]["mean"]
        -0.1
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Quantity]
    less: bool = False

    def to_dict(self) -> dict[str, Any]:
        return {
            "names": [self.name],
            "alias_set": list(self.alias_set),
            "probability": self.probability,
            "parameters": {key: value.to_dict() for key, value in self.parameters.items()},
            "less": self.less,
        }

    def __str__(self) -> str:
        name = f"less {self.name}" if self.less else self.name
        sizes = ", ".join(_text(key, q) for key, q in self.parameters.items() if _is_change(key))
        return f"{name} ({sizes})" if sizes else name


@dataclass(frozen=True)
class ChangeCause:
    """What has changed: `parts`, the first found first.

    `answer`: `"named"`; `"ambiguous"` where a part has aliases; `"unknown"` where something reproducible has changed
    that no effect explains; `"drift"` where a change is supported, but halves of one side differ by as much; `"none"`,
    also where a change is supported whose size is too uncertain. `detectable`: the least change of T_L and K_L (as a
    share) and of dead time [s] that these drives show, infinite (in JSON null) where they show none. `why`: one or two
    sentences.

    Example:
        >>> from avtorch.gap.change.change_cause import ChangeCause
        >>> ChangeCause((), "none", {"K_L": 0.03}, "No change is named.").to_dict()["names"]
        []
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
        return {
            "answer": self.answer,
            "names": list(self.names),
            "alias_set": list(dict.fromkeys(name for part in self.parts for name in part.alias_set)),
            "probability": self.probability,
            "parameters": {
                f"{part.name}.{key}": value.to_dict() for part in self.parts for key, value in part.parameters.items()
            },
            "parts": [part.to_dict() for part in self.parts],
            "detectable": {name: value if isfinite(value) else None for name, value in self.detectable.items()},
            "why": self.why,
        }


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
        if _is_change(key):
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


def _is_change(key: str) -> bool:
    return not key.startswith(("before", "after"))


def _text(key: str, q: Quantity) -> str:
    unit = unit_of(key)
    word = "" if key.startswith("change") else f"{words_of(key)} "
    return f"{word}{q.mean:+.3g}{'' if unit == '-' else ' ' + unit}, 90 % {q.q05:.3g} to {q.q95:.3g}"


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


def detectable_text(name: str, value: float) -> str:
    """A least change with its unit: a share of T_L and K_L, seconds of dead time."""
    if not isfinite(value):
        return "none"
    if name not in ("T_L", "K_L"):
        return f"{value:.2g} s"
    return f"{value:.0%}" if value > 0.02 else f"{100 * value:.1g}%"
