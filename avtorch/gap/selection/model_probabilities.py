"""Calibrated probabilities from log evidence, including the probability that the cause is not in the table.

Log evidence grows with every row and with every small model error, so its differences are overconfident. Three
corrections are made, all of them growing with the square root of the gain in nats, as the effect of a model error does:

- any effect pays a penalty, and the second of a pair another, larger one
- differences are compressed to a logarithm: `g` nats behind become odds of `(1 + g / unit) ** -power`
- the structure in the residuals of the most probable hypothesis (`Adequacy`) determines the probability of `unknown`

The constants come from `calibration.json` (`calibration.Calibration`), which states their meaning and the simulated
cases to which they were fitted; docs/calibration.md explains how to refit them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol, TypeVar

import numpy as np

from avtorch.errors import InputError
from avtorch.gap.selection.adequacy import Adequacy
from avtorch.gap.selection.calibration import CALIBRATION, Calibration, Odds, UnknownWeights
from avtorch.gap.simulator.effect import EFFECTS


class Weighed(Protocol):
    """The properties of a hypothesis used here, whether just fitted or kept from an earlier search."""

    @property
    def name(self) -> str: ...
    @property
    def log_evidence(self) -> float: ...
    @property
    def by_chance(self) -> object | None: ...


_Kind = TypeVar("_Kind", bound=Weighed)


@dataclass(frozen=True)
class ComplexityPenalty:
    """Penalty of an effect [nats]: `fixed`, plus `share` times the root of what its partner gains alone."""

    fixed: float
    share: float = 0.0

    def of(self, partner: float) -> float:
        return self.fixed + self.share * float(np.sqrt(max(partner, 0.0)))


# numerics, not fitted: the round-off [nats] of sums of up to some 1e9 of them
_ROUND_OFF = 1e-6


def model_probabilities(
    found: Sequence[Weighed],
    left: Adequacy,
    prior: Mapping[str, float] | None = None,
    *,
    calibration: Calibration = CALIBRATION,
) -> dict[str, float]:
    """Probability by hypothesis, including `unknown`; sums to 1.

    `left`: structure in the residuals of the most probable named hypothesis (`favourite`). `prior`: weights by name (an
    effect, `none`, `unknown`, or `pair` for all pairs) that multiply the default's. Raises `InputError` for weights
    that are negative or not finite.
    """
    weigh = dict(prior or {})
    for name, weight in weigh.items():
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError(f"prior: found {name}={weight!r}, needs a weight of 0 or more")
    shares = relative(found, calibration.odds)
    for f in found:
        parts = f.name.split("+")
        for part in parts:
            shares[f.name] *= weigh.get(part, 1.0)
        if len(parts) > 1:
            shares[f.name] *= weigh.get("pair", 1.0)
    total = sum(shares.values())
    regressors = signs(favourite(found, calibration.odds), _none(found), left)
    weights = [getattr(calibration.unknown, f.name) for f in fields(UnknownWeights)]
    odds = float(np.exp(sum(w * x for w, x in zip(weights, regressors, strict=True)))) * weigh.get("unknown", 1.0)
    unknown = odds / (1 + odds)
    if not total > 0:
        if not unknown > 0:
            raise InputError("prior: found weight 0 for every hypothesis, needs one above 0")
        return {name: 0.0 for name in shares} | {"unknown": 1.0}
    return {name: (1 - unknown) * share / total for name, share in shares.items()} | {"unknown": unknown}


def favourite(found: Sequence[_Kind], odds: Odds = CALIBRATION.odds) -> _Kind:
    """The most probable of the named hypotheses; of those equal within round-off, the simplest."""
    worth = _worth(found, odds)
    best = max(worth.values())
    tied = [f for f in found if worth[f.name] >= best - _ROUND_OFF]
    return min(tied, key=lambda f: (f.name != "none", f.name.count("+"), -worth[f.name]))


def complexity_penalties(found: Sequence[Weighed], odds: Odds = CALIBRATION.odds) -> dict[str, float]:
    """Penalty of each hypothesis [nats]: the gain over none that it must exceed."""
    second = ComplexityPenalty(odds.second, odds.second_share)
    second_by_chance = ComplexityPenalty(odds.second_by_chance, odds.second_by_chance_share)
    paid, gained = {"none": 0.0}, evidence_gains(found)
    for f in found:
        if f.name == "none":
            continue
        paid[f.name] = odds.effect
        if "+" in f.name:
            paid[f.name] += (second_by_chance if by_chance(f) else second).of(partner(f.name, gained))
    return paid


def by_chance(f: Weighed) -> bool:
    """Whether one of its causes is a random effect."""
    return f.by_chance is not None or any(part in EFFECTS and EFFECTS[part].random for part in f.name.split("+"))


def evidence_gains(found: Sequence[Weighed]) -> dict[str, float]:
    """Log evidence over none by name [nats]."""
    flat = _none(found).log_evidence
    return {f.name: f.log_evidence - flat for f in found}


def partner(pair: str, gained: Mapping[str, float]) -> float:
    """Gain of the stronger effect of a pair alone [nats]; 0 for an effect that was not fitted alone."""
    return max(gained.get(part, 0.0) for part in pair.split("+"))


def _none(found: Sequence[Weighed]) -> Weighed:
    return next(f for f in found if f.name == "none")


def _worth(found: Sequence[Weighed], odds: Odds) -> dict[str, float]:
    """Log evidence over none less the penalty of each hypothesis [nats]."""
    paid = complexity_penalties(found, odds)
    return {name: gained - paid[name] for name, gained in evidence_gains(found).items()}


def relative(found: Sequence[Weighed], odds: Odds = CALIBRATION.odds) -> dict[str, float]:
    """Probability of each named hypothesis relative to the most probable one, before the user's prior."""
    worth = _worth(found, odds)
    best = max(worth.values())
    unit = odds.unit + odds.unit_share * float(np.sqrt(max(best, 0.0)))
    return {name: float((1 + (best - w) / unit) ** -odds.power) for name, w in worth.items()}


def signs(top: Weighed, none: Weighed, left: Adequacy) -> tuple[float, ...]:
    """Regressors of the log odds of `unknown`, in the order of `UnknownWeights`.

    1, the strongest structure in the residuals, all structure relative to the gain of the favourite `top`, that gain,
    and whether `top` is none. The divisors only scale logarithms of nats to the order of 1, so that one prior serves
    all weights.
    """
    gain = float(np.log1p(max(top.log_evidence - none.log_evidence, 0.0)))
    most = max(left.flexible, left.drift, left.line, left.memory, left.bursts)
    return (
        1.0,
        float(np.log1p(max(most, 0.0))) / 3,
        (float(np.log1p(max(left.total, 0.0))) - gain) / 5,
        gain / 5,
        float(top.name == "none"),
    )
