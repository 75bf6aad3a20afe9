"""One case beside the diagnosis's answer to it, read from plain dicts (`avtorch.diagnosis/1` or `/2`).

The verdict names the parts whose probability is 0.5 or more, then causes of chance. Parts below that are in the budget
without being named: the score of names does not see them, the calibration of probabilities does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from avtorch.errors import InputError
from benchmarks.blindtest.ambiguity import causes, group_utility

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


# One case beside the diagnosis's answer to it, read from plain dicts (`avtorch.diagnosis/1` or `/2`).
SCHEMAS = ("avtorch.diagnosis/1", "avtorch.diagnosis/2")
"""The schemas of answers that can be scored."""
FAILED = "failed"
"""Verdict of a diagnosis that gave no answer; it counts as wrong for every truth."""


def canonical_name(names: Any) -> str:
    """The names of a verdict, or of one hypothesis (`"b+a"`), in the canonical order: `"a+b"`."""
    parts = names.split("+") if isinstance(names, str) else list(names)
    return "+".join(sorted(parts))


@dataclass(frozen=True)
class Answered:
    """A case with its answer.

    `truth`: `none`, `unknown` (a cause outside the table), an effect, or several joined by `+`; `kind`, `tier` of the
    case. `verdict` takes the same values; `probabilities` by hypothesis; `alias_set`. `closed_error`, `closed_covered`,
    `placebo` (mean, q05), `onset_error` [s]: None where the case or the answer has none. `overlaps`: overlap of each
    true part of the gap with the part named on its axis; `parts_named`: how many parts are named. `partial`: the answer
    says that something material is left beside what it names. `budget`, `true_budget`: None where there is none;
    `outside`: whether a cause outside the table is among the case's. `true_parameters`: the causes' numbers, by name.
    """

    truth: str
    kind: str
    tier: str | None
    verdict: str
    probabilities: Mapping[str, float]
    alias_set: frozenset[str]
    closed_error: float | None
    closed_covered: bool | None
    placebo: Mapping[str, float] | None
    onset_error: float | None
    overlaps: tuple[float, ...]
    parts_named: int
    partial: bool = False
    budget: AnsweredBudget | None = None
    true_budget: Mapping[str, Any] | None = None
    outside: bool = False
    true_parameters: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def named(self) -> tuple[str, ...]:
        """The effects that the verdict names; none for `none`, `unknown` and without an answer."""
        return () if self.verdict in ("", "none", "unknown", FAILED) else tuple(self.verdict.split("+"))

    @property
    def right(self) -> bool:
        return self.truth == self.verdict

    @property
    def confidence(self) -> float:
        """Probability of the most probable hypothesis, 0 where there is no answer."""
        return max(self.probabilities.values(), default=0.0)

    @property
    def favourite(self) -> str:
        """The most probable hypothesis; the verdict in case of a tie."""
        if self.probabilities.get(self.verdict, -1.0) >= self.confidence:
            return self.verdict
        return max(self.probabilities, key=lambda name: self.probabilities[name], default=FAILED)

    @property
    def blamed(self) -> float:
        """The highest probability given to any named effect or pair."""
        return max((p for name, p in self.probabilities.items() if name not in ("none", "unknown")), default=0.0)

    @property
    def brier(self) -> float:
        """Sum of squared errors over the hypotheses; a truth that the answer does not list has probability 0."""
        missed = 0.0 if self.truth in self.probabilities else 1.0
        return missed + sum((p - (name == self.truth)) ** 2 for name, p in self.probabilities.items())

    @property
    def blamed_alone(self) -> bool:
        """Whether the verdict names effects and does not say that something material is left besides."""
        return bool(self.named) and not self.partial

    def utility(self, *, weighted: bool = False) -> float:
        """Utility of the alias set as an ambiguity group (`benchmarks.blindtest.ambiguity`), 0 without an answer.

        `weighted` by the probabilities of its members. A `partial` answer holds a cause outside the table, too.
        """
        if self.verdict == FAILED:
            return 0.0
        also = frozenset({"unknown"}) if self.partial else frozenset()
        group: dict[frozenset[str], float] = {}
        for name in sorted(self.alias_set | {self.verdict}):
            one = causes(name) | also
            group[one] = group.get(one, 0.0) + self.probabilities.get(name, 0.0)
        true = causes(self.truth) | (frozenset({"unknown"}) if self.outside else frozenset())
        return group_utility(group if weighted else list(group), [true])


def read_answer(truth: Mapping[str, Any], answer: Mapping[str, Any] | None) -> Answered:
    """Read a truth (`Case.truth()`) and the answer to its log (None: no answer).

    Beside the schema's fields, `answer["shrinkage"]["placebo"]["closed"]` may hold the share of the held-out gap that a
    wrong effect closed. An answer without `schema` is read as `avtorch.diagnosis/1`. Raises `InputError` for another
    schema, for probabilities that do not sum to 1, where `none` or `unknown` is missing, and for a budget whose parts
    are not one name each.
    """
    of, of_case = str(truth.get("case", "answer")), _of_case(truth)
    if answer is None:
        return Answered(
            **of_case,
            verdict=FAILED,
            probabilities={},
            alias_set=frozenset(),
            closed_error=None,
            closed_covered=None,
            placebo=None,
            onset_error=None,
            overlaps=(),
            parts_named=0,
        )
    schema = answer.get("schema", SCHEMAS[0])
    if schema not in SCHEMAS:
        raise InputError(f"{of}: found schema {schema!r}, needs {' or '.join(SCHEMAS)}")
    probabilities = {canonical_name(effect["name"]): float(effect["probability"]) for effect in answer["effects"]}
    if abs(sum(probabilities.values()) - 1) > 1e-6 or min(probabilities.values(), default=-1) < 0:
        raise InputError(f"{of}: probabilities sum to {sum(probabilities.values()):.8g}, need 1 and none below 0")
    if not {"none", "unknown"} <= probabilities.keys():
        raise InputError(f"{of}: found {', '.join(probabilities)}, needs none and unknown among the hypotheses")
    verdict = canonical_name(answer["verdict"]["names"])
    budget = read_budget(answer) if schema == SCHEMAS[1] else None
    named_right = verdict == truth["verdict"]
    return Answered(
        **of_case,
        verdict=verdict,
        probabilities=probabilities,
        alias_set=_alias_set(answer, verdict, budget),
        closed_error=_closed_error(truth, answer) if named_right else None,
        closed_covered=_closed_covered(truth, answer) if named_right else None,
        placebo=_placebo(answer),
        onset_error=_onset_error(truth, answer, budget) if named_right else None,
        overlaps=tuple(_overlap(part, answer) for part in truth.get("where") or ()),
        parts_named=len(answer.get("where") or ()),
        partial=schema == SCHEMAS[1] and bool(answer["verdict"].get("partial")),
        budget=budget,
    )


def _of_case(truth: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `Answered` that do not depend on the answer."""
    outside = truth["kind"] == "outside" or bool(truth.get("outside"))
    return {
        "truth": truth["verdict"],
        "kind": truth["kind"],
        "tier": truth["tier"],
        "outside": outside,
        "true_budget": truth.get("budget"),
        "true_parameters": truth.get("parameters") or {},
    }


def _alias_set(answer: Mapping[str, Any], verdict: str, budget: AnsweredBudget | None) -> frozenset[str]:
    """The verdict's alias set. Where it has no alternative and a budget's parts have some, the verdict with one part
    at a time replaced: the alternatives of a part are conditional on the other parts."""
    listed = frozenset(canonical_name(name) for name in answer["verdict"]["alias_set"])
    if budget is None or listed - {verdict}:
        return listed
    names = set(verdict.split("+"))
    for part in (*budget.parts, *budget.chance):
        if part.name in names:
            listed |= {canonical_name((names - {part.name}) | {other}) for other in part.alias_set}
    return listed


def _closed_error(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> float | None:
    """Absolute difference between the answer's `closed` and the oracle's."""
    oracle, closed = _oracle_closed(truth, answer), _closed(answer)
    return None if oracle is None or closed is None else abs(float(closed["mean"]) - oracle)


def _closed_covered(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> bool | None:
    """Whether the 90 % interval of the answer's `closed` covers the oracle's."""
    oracle, closed = _oracle_closed(truth, answer), _closed(answer)
    return None if oracle is None or closed is None else bool(closed["q05"] <= oracle <= closed["q95"])


def _oracle_closed(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> float | None:
    """The share closed, computed with the true noise floor, which follows from the known cause.

    It uses the answer's own held-out errors before and after. None where there was nothing to close.
    """
    shrinkage = answer.get("shrinkage") or {}
    oracle = (truth.get("oracle") or {}).get(shrinkage.get("metric"))
    if oracle is None or oracle["closed"] is None:
        return None
    before, after, floor = float(shrinkage["before"]), float(shrinkage["after"]), float(oracle["floor"])
    return (before - after) / (before - floor) if before > floor else None


def _closed(answer: Mapping[str, Any]) -> Mapping[str, float] | None:
    return (answer.get("shrinkage") or {}).get("closed")


def _onset_error(truth: Mapping[str, Any], answer: Mapping[str, Any], budget: AnsweredBudget | None) -> float | None:
    """Difference between reported and true onset [s]; the length of the drive where the answer reports none.

    Parts of a budget have onsets of their own: without one for the whole answer the earliest of the named parts counts.
    """
    if truth["onset_s"] is None or not truth["onset_scored"]:
        return None
    onset = answer.get("onset_s")
    if onset is None and budget is not None:
        parts = [part for part in (*budget.parts, *budget.chance) if part.named]
        onset = min((part.onset_s for part in parts if part.onset_s is not None), default=None)
    return float(truth["drive"]["seconds"]) if onset is None else abs(float(onset) - float(truth["onset_s"]))


def _placebo(answer: Mapping[str, Any]) -> Mapping[str, float] | None:
    return ((answer.get("shrinkage") or {}).get("placebo") or {}).get("closed")


def _overlap(part: Mapping[str, Any], answer: Mapping[str, Any]) -> float:
    """Intersection over union of a true part and the part named on the same axis; 0 where none is named."""
    named = next((w for w in answer.get("where") or () if w["axis"] == part["axis"]), None)
    if named is None:
        return 0.0
    ends = [float(named["from"]), float(part["from"])], [float(named["to"]), float(part["to"])]
    whole = max(ends[1]) - min(ends[0])
    return max(0.0, min(ends[1]) - max(ends[0])) / whole if whole > 0 else 0.0
