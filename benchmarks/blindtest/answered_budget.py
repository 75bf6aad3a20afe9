"""The budget of the gap in an answer of `avtorch.diagnosis/2`, read from plain dicts.

The verdict names the parts whose probability is 0.5 or more, then causes of chance. Parts below that are in the budget
without being named: the score of names does not see them, the calibration of probabilities does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avtorch.errors import InputError

NAMED_FROM = 0.5
"""Probability from which a verdict names a part."""


@dataclass(frozen=True)
class AnsweredPart:
    """One cause of an answer's budget: `share` of the gap (None for a cause of chance, which takes nothing off it), its
    `alias_set` (holds `name`), `onset_s` [s] or None, `parameters` by name as the answer has them."""

    name: str
    probability: float
    share: float | None
    alias_set: frozenset[str]
    onset_s: float | None
    parameters: Mapping[str, Any]

    @property
    def named(self) -> bool:
        return self.probability >= NAMED_FROM


@dataclass(frozen=True)
class AnsweredBudget:
    """`parts` and causes of `chance`, in the answer's order; `unexplained`: share of the gap that is left."""

    parts: tuple[AnsweredPart, ...]
    chance: tuple[AnsweredPart, ...]
    unexplained: float

    @property
    def shares(self) -> Mapping[str, float]:
        """Shares of the named parts, by name."""
        return {part.name: part.share for part in self.parts if part.named and part.share is not None}

    def part(self, name: str) -> AnsweredPart | None:
        return next((part for part in (*self.parts, *self.chance) if part.name == name), None)


def read_budget(answer: Mapping[str, Any]) -> AnsweredBudget | None:
    """The answer's budget; None where it has none, as all answers of `avtorch.diagnosis/1`.

    Raises `InputError` for parts that do not hold one name each or probabilities outside 0 to 1.
    """
    budget = answer.get("budget")
    if budget is None:
        return None
    parts, chance = (tuple(_part(one) for one in budget[key]) for key in ("parts", "chance"))
    return AnsweredBudget(parts, chance, float(budget["unexplained"]["share"]["mean"]))


def _part(one: Mapping[str, Any]) -> AnsweredPart:
    names, probability = list(one["names"]), float(one["probability"])
    if len(names) != 1:
        raise InputError(f"budget: found a part of {len(names)} names, needs one")
    if not 0 <= probability <= 1:
        raise InputError(f"budget: {names[0]} has probability {probability:g}, needs 0 to 1")
    share, onset = one.get("share"), one.get("onset_s")
    return AnsweredPart(
        name=names[0],
        probability=probability,
        share=None if share is None else float(share["mean"]),
        alias_set=frozenset(one.get("alias_set") or names) | {names[0]},
        onset_s=None if onset is None else float(onset),
        parameters=one.get("parameters") or {},
    )
