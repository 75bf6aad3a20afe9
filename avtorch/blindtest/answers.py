"""One case beside the diagnosis's answer to it, read from plain dicts (`avtorch.diagnosis/1`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avtorch.errors import InputError

FAILED = "failed"
"""Verdict of a diagnosis that gave no answer; it counts as wrong for every truth."""


def canonical_name(names: Any) -> str:
    """The names of a verdict, or of one hypothesis (`"b+a"`), in the canonical order: `"a+b"`."""
    parts = names.split("+") if isinstance(names, str) else list(names)
    return "+".join(sorted(parts))


@dataclass(frozen=True)
class Answered:
    """A case with its answer.

    `truth`: `none`, `unknown` (a cause outside the table), an effect, or two joined by `+`; `kind`, `tier` of the case.
    `verdict` takes the same values; `probabilities` by hypothesis; `alias_set`. `closed_error`, `closed_covered`,
    `placebo` (mean, q05), `onset_error` [s]: None where the case or the answer has none. `overlaps`: overlap of each
    true part of the gap with the part named on its axis; `parts_named`: how many parts are named.
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


def read_answer(truth: Mapping[str, Any], answer: Mapping[str, Any] | None) -> Answered:
    """Read a truth (`Case.truth()`) and the answer to its log (None: no answer).

    Beside the schema's fields, `answer["shrinkage"]["placebo"]["closed"]` may hold the share of the held-out gap that a
    wrong effect closed. Raises `InputError` for probabilities that do not sum to 1, or where `none` or `unknown` is
    missing.
    """
    of = str(truth.get("case", "answer"))
    if answer is None:
        return Answered(
            truth["verdict"], truth["kind"], truth["tier"], FAILED, {}, frozenset(), None, None, None, None, (), 0
        )
    probabilities = {canonical_name(effect["name"]): float(effect["probability"]) for effect in answer["effects"]}
    if abs(sum(probabilities.values()) - 1) > 1e-6 or min(probabilities.values(), default=-1) < 0:
        raise InputError(f"{of}: probabilities sum to {sum(probabilities.values()):.8g}, need 1 and none below 0")
    if not {"none", "unknown"} <= probabilities.keys():
        raise InputError(f"{of}: found {', '.join(probabilities)}, needs none and unknown among the hypotheses")
    verdict = canonical_name(answer["verdict"]["names"])
    named_right = verdict == truth["verdict"]
    return Answered(
        truth=truth["verdict"],
        kind=truth["kind"],
        tier=truth["tier"],
        verdict=verdict,
        probabilities=probabilities,
        alias_set=frozenset(canonical_name(name) for name in answer["verdict"]["alias_set"]),
        closed_error=_closed_error(truth, answer) if named_right else None,
        closed_covered=_closed_covered(truth, answer) if named_right else None,
        placebo=_placebo(answer),
        onset_error=_onset_error(truth, answer) if named_right else None,
        overlaps=tuple(_overlap(part, answer) for part in truth.get("where") or ()),
        parts_named=len(answer.get("where") or ()),
    )


def _closed_error(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> float | None:
    """Absolute difference between the answer's `closed` and the oracle's."""
    oracle, said = _oracle_closed(truth, answer), _closed(answer)
    return None if oracle is None or said is None else abs(float(said["mean"]) - oracle)


def _closed_covered(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> bool | None:
    """Whether the 90 % interval of the answer's `closed` covers the oracle's."""
    oracle, said = _oracle_closed(truth, answer), _closed(answer)
    return None if oracle is None or said is None else bool(said["q05"] <= oracle <= said["q95"])


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


def _onset_error(truth: Mapping[str, Any], answer: Mapping[str, Any]) -> float | None:
    """Difference between reported and true onset [s]; the length of the drive where the answer reports none."""
    if truth["onset_s"] is None or not truth["onset_scored"]:
        return None
    said = answer.get("onset_s")
    return float(truth["drive"]["seconds"]) if said is None else abs(float(said) - float(truth["onset_s"]))


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
