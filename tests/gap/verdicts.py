"""Verdicts for tests of what is made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from avtorch.gap.result.hypotheses import ALIAS_RATIO, Candidate, Verdict, candidate_name, listed_candidates

Aliases = Callable[[Sequence[Candidate]], Iterable[str]]


def near(ratio: float) -> Aliases:
    """All hypotheses at least `ratio` as probable as the first; `unknown` from a half on."""
    return lambda ranked: [
        c.name for c in ranked if c.probability >= (0.5 if c.name == "unknown" else ratio) * ranked[0].probability
    ]


def verdict_of(candidates: Iterable[Candidate], *, aliases: Aliases | None = None) -> Verdict:
    """The most probable hypothesis as a verdict; `aliases` returns the names that cannot be distinguished from it."""
    first, second, *_ = ranked = listed_candidates(candidates)
    names = [first.name, *map(candidate_name, (aliases or near(ALIAS_RATIO))(ranked))]
    words = {"none": "that nothing is missing", "unknown": "a cause without a name"}
    rival = f"next likeliest, with {second.probability:.3g}, is {words.get(second.name, second.name)}"
    why = f"{first.name} has probability {first.probability:.3g}; {rival}."
    return Verdict(first.effects or (first.name,), tuple(dict.fromkeys(names)), first.name == "unknown", why)
