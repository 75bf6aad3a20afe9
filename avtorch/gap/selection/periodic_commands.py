"""Ambiguity under a periodic command: a delay is identified only up to the period, and may be zero."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from avtorch.gap.answer.verdict import Verdict
from avtorch.gap.search.fitted_model import FittedModel

_NAMED = 4  # delays named in a sentence


def undetermined_delays(found: Iterable[FittedModel]) -> dict[str, FittedModel]:
    """Fitted models, by name, whose delay may be zero."""
    return {f.name: f for f in found if f.delays is not None and f.delays.may_be_zero}


def shared(chances: Mapping[str, float], undetermined: Mapping[str, FittedModel]) -> dict[str, float]:
    """Probabilities after the share of near-zero delays is moved to the same model without a delay."""
    out = dict(chances)
    for name, f in undetermined.items():
        assert f.delays is not None
        if not out.get(f.delays.without):
            continue  # excluded by the prior
        part = chances[name] * f.delays.none
        out[name] -= part
        out[f.delays.without] += part
    return out


def add_delay_aliases(aliases: Sequence[str], undetermined: Mapping[str, FittedModel]) -> list[str]:
    """The alias set, verdict first, with the model that differs from the verdict only by an undetermined delay."""
    more = []
    for name, f in undetermined.items():
        assert f.delays is not None
        pair = (name, f.delays.without)
        if aliases[0] in pair:
            more += pair
    return list(dict.fromkeys([*aliases, *more]))


def why(chances: Mapping[str, float], undetermined: Mapping[str, FittedModel]) -> str | None:
    """The verdict's sentence, where an alias differs from it only by a delay; None elsewhere."""
    first = max(chances, key=lambda name: chances[name])
    for name, f in undetermined.items():
        assert f.delays is not None
        if first in (name, f.delays.without):
            ambiguity = f"this log cannot distinguish {f.delays.without} from {name}"
            return f"{_repeats(f)}, so {ambiguity}; {first} has probability {chances[first]:.3g}."
    return None


def notes(found: Iterable[FittedModel], verdict: Verdict) -> list[str]:
    """The note on an undetermined delay in the alias set, and the experiment that would determine it."""
    for f in found:
        if f.delays is None or f.name not in verdict.alias_set:
            continue
        if len(f.delays.lengths) > 1 or f.delays.may_be_zero:
            return [f"{_repeats(f)}: to estimate the delay, drive with a command that does not repeat."]
    return []


def _repeats(found: FittedModel) -> str:
    given = found.delays
    assert given is not None
    if len(given.lengths) == 1:
        return f"The command repeats every {given.period:.3g} s, so a delay and a longer lag fit equally well"
    named = [f"{x:.3f}" for x in given.lengths[:_NAMED]]
    more = len(given.lengths) - _NAMED
    listing = ", ".join(named) + (f" s and {more} more" if more > 0 else " s")
    return f"The command repeats every {given.period:.3g} s, so delays of {listing} fit equally well"
