"""Hypotheses, their probabilities, and the verdict based on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from avtorch.errors import InputError
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import EFFECTS

ALWAYS = ("none", "unknown")
LEAST_LISTED = 1e-4
"""Hypotheses less probable than this are left out of an answer; `none` and `unknown` never are."""


def candidate_name(names: str | Iterable[str]) -> str:
    """The canonical name of a hypothesis: its effects in alphabetical order, joined by `+`."""
    return "+".join(sorted(names.split("+") if isinstance(names, str) else names))


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: `"none"`, `"unknown"`, an effect, or two (`"a+b"`, in alphabetical order).

    `log_evidence` [nats] relative to `none`, without the prior over causes; None for `unknown`. `parameters` by the
    table's names, those of a pair as `effect.parameter`; `moved`: the baseline's `T_L` [s] and `K_L` [-] under this
    hypothesis. `onset_s` on the log's own clock; None where the effect acts from the start. `implausible`: a sentence
    for each parameter outside its physically possible range (`plausibility.implausible`).
    """

    name: str
    probability: float
    log_evidence: float | None = None
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    moved: Mapping[str, Quantity] = field(default_factory=dict)
    onset_s: float | None = None
    implausible: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.name != candidate_name(self.name):
            raise InputError(f"candidate: found {self.name!r}, needs {candidate_name(self.name)!r}")
        if not 0 <= self.probability <= 1 + 1e-9:
            raise InputError(f"{self.name}: found probability {self.probability!r}, needs 0 to 1")

    @property
    def effects(self) -> tuple[str, ...]:
        """Its effects: none, one or two."""
        return () if self.name in ALWAYS else tuple(self.name.split("+"))

    def to_dict(self) -> dict[str, Any]:
        """An entry of `effects`."""
        return {
            "name": self.name,
            "probability": self.probability,
            "log_evidence": self.log_evidence,
            "parameters": plain(self.parameters),
            "moved": plain(self.moved),
            "onset_s": self.onset_s,
            **plausibility(self.implausible),
        }


def plausibility(implausible: Sequence[str]) -> dict[str, Any]:
    """The keys `plausible` and, where it is False, `plausibility` with the reasons."""
    return {"plausible": not implausible, "plausibility": " ".join(implausible) or None}


def listed_candidates(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Hypotheses as listed in an answer: improbable ones left out, renormalised to a sum of 1, most probable first.

    Raises `InputError` where `none` or `unknown` is missing, a name occurs twice, or no probability is above 0.
    """
    given = list(candidates)
    names = [c.name for c in given]
    if len(set(names)) < len(names) or not set(ALWAYS) <= set(names):
        raise InputError(f"candidates: found {', '.join(names)}, needs none and unknown and each name once")
    # improbable by their share, so that weights need not be normalised
    total = math.fsum(c.probability for c in given)
    if not total > 0:
        raise InputError("candidates: found no probability above 0, needs one")
    kept = [c for c in given if c.name in ALWAYS or c.probability >= LEAST_LISTED * total]
    total = math.fsum(c.probability for c in kept)
    kept.sort(key=lambda c: -c.probability)
    shares = [c.probability / total for c in kept]
    shares[0] = 1 - math.fsum(shares[1:])
    return tuple(replace(c, probability=share) for c, share in zip(kept, shares, strict=True))


@dataclass(frozen=True)
class Verdict:
    """The named causes, and the hypotheses that cannot be distinguished from them.

    `names`: `("none",)`, `("unknown",)`, or the effects, the one with the largest share of the gap first. `alias_set`:
    the hypotheses that this log cannot distinguish, including the verdict. `abstained`: it is `unknown`. `why`: one
    sentence. `partial`: effects are named, and something reproducible is left that no known effect explains.
    """

    names: tuple[str, ...]
    alias_set: tuple[str, ...]
    abstained: bool
    why: str
    partial: bool = False

    @property
    def name(self) -> str:
        """The verdict as a hypothesis's name."""
        return candidate_name(self.names)

    def to_dict(self) -> dict[str, Any]:
        return {
            "names": list(self.names),
            "alias_set": list(self.alias_set),
            "abstained": self.abstained,
            "partial": self.partial,
            "why": self.why,
        }


ALIAS_RATIO = 0.03
"""Hypotheses at least this probable, relative to the most probable one, are not distinguished from it."""
UNKNOWN_RATIO = 0.5
"""The same for `unknown`, which makes no predictions and so is never ruled out by a log: below this it is no rival."""


def near(ratio: float, unknown: float = UNKNOWN_RATIO) -> Callable[[Sequence[Candidate]], tuple[str, ...]]:
    """A function that returns the alias set: all hypotheses at least `ratio` as probable as the first, which leads.

    For `unknown` the ratio is `unknown`.
    """

    def aliases(candidates: Sequence[Candidate]) -> tuple[str, ...]:
        ranked = sorted(candidates, key=lambda c: -c.probability)
        first = ranked[0].probability
        return tuple(c.name for c in ranked if c.probability >= (unknown if c.name == "unknown" else ratio) * first)

    return aliases


def verdict_of(
    candidates: Iterable[Candidate],
    *,
    aliases: Callable[[Sequence[Candidate]], Iterable[str]] | None = None,
    why: str | None = None,
    known: str = "known effect",
) -> Verdict:
    """The most probable hypothesis as a verdict.

    `aliases` returns the names that cannot be distinguished (the verdict's is put first; default `near(ALIAS_RATIO)`);
    `why` defaults to a sentence on evidence and runner-up, in which `known` describes what was tried.
    """
    ranked = listed_candidates(candidates)
    first = ranked[0]
    others = [name for name in map(candidate_name, (aliases or near(ALIAS_RATIO))(ranked)) if name != first.name]
    names = first.effects or (first.name,)
    return Verdict(names, (first.name, *dict.fromkeys(others)), first.name == "unknown", why or _why(ranked, known))


def _why(ranked: Sequence[Candidate], known: str) -> str:
    first, second = ranked[0], ranked[1]
    words = {"none": "that nothing is missing", "unknown": "a cause that is not in the table of effects"}
    rival = f"next likeliest, with {second.probability:.3g}, is {words.get(second.name, second.name)}"
    if first.name == "none":
        which = "effect" if known == "known effect" else known
        return f"No {which} explains the log better than the baseline does; {rival}."
    if first.name == "unknown":
        return f"No {known} leaves residuals that could be noise; {rival}."
    return f"{first.name} has probability {first.probability:.3g}; {rival}."


def plain(quantities: Mapping[str, Quantity]) -> dict[str, dict[str, float]]:
    """Quantities as plain numbers, for JSON."""
    return {name: quantity.to_dict() for name, quantity in quantities.items()}


def meanings(name: str) -> str:
    """The meaning of a hypothesis's effects, in words; empty for an effect that is not registered."""
    known = [EFFECTS[n].meaning for n in candidate_name(name).split("+") if n in EFFECTS]
    return ", and ".join(known)
