"""Effects put in front of a recording: what the budget says of each, and the counts over all of them.

A recording shows an effect that it excites: at the size put in, the effect changes what the best set of the untouched
recording predicts by more than that set's parameters can follow. Half the square of the rest, in units of the noise, is
what it can gain [nats] (Kay 1998, section 13.7); below `EFFECT_NATS` no diagnosis could name it. Rows that a limit
drops are counted, so a limit's figure is too large; and the rest is linear, so a long delay's is too.

The untouched recording has a gap of its own, so a size is compared twice: on top of what the untouched recording's
answer has of the effect; and "beside the same effects", on top of what the untouched recording has of it where the
effects of the changed recording's answer are fitted. What a car has of an effect may be too little to be named.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from avtorch import diagnose
from avtorch.errors import InputError
from avtorch.gap import EFFECTS
from avtorch.gap.engine.coordinates import EFFECTS as TRIED
from avtorch.gap.engine.coordinates import base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.inference import infer
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import EFFECT_NATS
from avtorch.gap.engine.promises import Projection
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.engine.sample import sample
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.budget import Budget, Part
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.io import Log
from benchmarks.blindtest import IN_FRONT, put_in_front
from benchmarks.blindtest.intervals import counted
from benchmarks.blindtest.parameter_score import SIZE_OF, SIZE_WITHIN
from benchmarks.budget_cells import causes

_COLUMNS = (
    "effect",
    "excited [nats]",
    "",
    "size",
    "interval holds",
    "size, same effects",
    "interval holds, same effects",
    "others",
    "budget",
)
HEADER = f"| {' | '.join(_COLUMNS)} |\n{'|---' * len(_COLUMNS)}|"


@dataclass(frozen=True)
class Size:
    """`ratio`: a size that was found over the size put in; `holds`: whether the 90 % interval holds what was put in."""

    ratio: float
    holds: bool

    @property
    def right(self) -> bool:
        return abs(self.ratio - 1) <= SIZE_WITHIN


@dataclass(frozen=True)
class InFront:
    """What is said of a recording with `effect` in front of it.

    `excited`: the nats that it can gain there, not known of what chance decides. `named`: the verdict holds it;
    `alias`: it holds what these drives cannot tell from it. `size`, `same`: None where it is not named.
    `others`: names that neither the effect nor the untouched recording accounts for; `nothing`: whether the verdict is
    `none` or `unknown`.
    """

    effect: str
    put_in: Mapping[str, float]
    excited: float
    named: bool
    alias: bool
    size: Size | None
    same: Size | None
    others: tuple[str, ...]
    nothing: bool
    budget: str

    def __str__(self) -> str:
        """Its row of the table under `HEADER`."""
        truth = ", ".join(f"{value:.3g}" for value in self.put_in.values())
        sizes = [cell for size in (self.size, self.same) for cell in _cells(size)]
        found = "named" if self.named else "alias" if self.alias else "missed"
        nats = "" if math.isnan(self.excited) else f"{self.excited:.0f}"
        rest = " | ".join((found, *sizes, ", ".join(self.others), self.budget))
        return f"| {self.effect} ({truth}) | {nats} | {rest} |"


def _cells(size: Size | None) -> tuple[str, str]:
    return ("", "") if size is None else (f"{size.ratio:.2f}", "yes" if size.holds else "no")


def closing(rows: Sequence[InFront]) -> list[str]:
    """The counts over all rows, with Wilson's 90 % intervals; names also over what the recording excites."""

    def of_all(hits: Sequence[bool]) -> str:
        return counted(sum(hits), len(hits))

    sizes, same = [row.size for row in rows if row.size], [row.same for row in rows if row.same]
    named, alike = [row.named for row in rows], [row.named or row.alias for row in rows]
    seen = [row.named for row in rows if not row.excited <= EFFECT_NATS]
    others = [bool(row.others) for row in rows]
    return [
        f"named {of_all(named)}, of what it excites {of_all(seen)}, with aliases {of_all(alike)}; "
        f"with others {of_all(others)}; none or unknown {of_all([row.nothing for row in rows])}",
        f"sizes within {100 * SIZE_WITHIN:.0f} % {of_all([size.right for size in sizes])}, "
        f"beside the same effects {of_all([size.right for size in same])}",
        f"intervals that hold {of_all([size.holds for size in sizes])}, "
        f"beside the same effects {of_all([size.holds for size in same])}",
    ]


def budget_of(log: Log) -> Budget:
    """Raises `InputError` for a log too short to hold out five blocks."""
    budget = diagnose(log).budget
    if budget is None:
        raise InputError(f"{log.name}: found {log.seconds:.0f} s, needs five blocks of 4 s")
    return budget


def in_front(log: Log, size: float) -> None:
    """Prints a row per effect, and the counts. What chance decides has no size."""
    control, alone = budget_of(log), base_fit(DriveData.of(log))
    print(f"{HEADER}\n| untouched | | | | | | | | {causes(control)} |", flush=True)
    T_L, K_L = alone["T_L"], alone["K_L"]
    visited = infer(DriveData.of(with_sensor_noise(log)[0])).search.visited.values()
    best = max(visited, key=lambda h: h.score)
    rows: list[InFront] = []
    for number, effect in enumerate(IN_FRONT):
        try:
            changed, put_in = put_in_front(log, effect, T_L=T_L, K_L=K_L, size=size, seed=number)
            budget = budget_of(changed)
        except InputError:
            continue
        before, sized = size_of(control, effect), not EFFECTS[effect].random
        own = _beside_the_same(budget, alone, effect, changed.epoch_s) if sized else None
        rows.append(
            InFront(
                effect,
                put_in,
                excited(best, effect, put_in),
                named=effect in budget.names,
                alias=any(effect in x.alias_set for x in (*budget.parts, *budget.chance) if x.name in budget.names),
                size=compared(budget, effect, put_in, None if before is None else before.mean) if sized else None,
                same=None if own is None else compared(budget, effect, put_in, own),
                others=tuple(name for name in budget.names if name != effect and name not in control.names),
                nothing=not budget.names,
                budget=causes(budget),
            )
        )
        print(rows[-1], flush=True)
    print("\n".join(closing(rows)), flush=True)


def excited(h: Hypothesis, effect: str, put_in: Mapping[str, float]) -> float:
    """What the effect can gain beside the hypothesis [nats], at the values put in on top of those that it has."""
    if effect not in TRIED:
        return math.nan
    own = TRIED[next((e for e in h.effects if base_name(e) == effect), effect)]
    at = [h[c.name] if own.name in h.effects else 0.0 for c in own.coordinates]
    at = [
        x + c.coordinate(put_in[c.parameter]) if c.parameter in put_in else x or start
        for x, c, start in zip(at, own.coordinates, (own.starts or ((0.0, 0.0),))[0], strict=True)
    ]
    beside = h.without(own.name) if own.name in h.effects else h
    beside = beside.with_effect(own.name, at, h.onsets.get(own.name, put_in.get("change_s")))
    left = Projection(h)(whiten(h.data, h.covariance, beside.response() - h.predicted))
    return 0.5 * float(left @ left)


def compared(budget: Budget, effect: str, put_in: Mapping[str, float], before: float | None) -> Size | None:
    """The size found, and its interval, on top of `before` (None: none of it); None where it is not named."""
    key, without, relative = SIZE_OF[effect]
    found = size_of(budget, effect)
    if found is None:
        return None
    before = without if before is None else before
    ratio, *ends = (relative(x, before, put_in[key]) for x in (found.mean, found.q05, found.q95))
    known = [end for end in ends if end is not None]
    # a factor whose interval reaches 0 has no logarithm there
    return None if ratio is None else Size(ratio, len(known) == 2 and min(known) <= 1 <= max(known))


def size_of(budget: Budget, effect: str) -> Quantity | None:
    """The size of a part, None where it is not named."""
    part = next((part for part in budget.parts if part.name == effect and effect in budget.names), None)
    return None if part is None else part.parameters.get(SIZE_OF[effect][0])


def _beside_the_same(budget: Budget, alone: Hypothesis, effect: str, epoch_s: float) -> float | None:
    """What the untouched recording has of the effect when the effects named are fitted to it, None without a name.

    `alone`: its base.
    """
    if size_of(budget, effect) is None:
        return None
    h = alone
    for part in budget.parts:
        if part.name in budget.names and part.name in map(base_name, TRIED):  # what chance decides is in the noise
            h = with_part(h, part, epoch_s)
    h = fit(h, 12)
    kept = next(e for e in h.effects if base_name(e) == effect)
    of = next(c for c in TRIED[kept].coordinates if c.parameter == SIZE_OF[effect][0])
    draws = sample(h, chains=1, draws=1000, seed=0, method="laplace")[of.name].reshape(-1)
    return float(np.mean([of.value(x) for x in draws.tolist()]))


def with_part(h: Hypothesis, part: Part, epoch_s: float) -> Hypothesis:
    """The hypothesis with a part of a budget, from its first start and its onset on."""
    names = [e for e in TRIED if base_name(e) == part.name]
    late = part.onset_s is not None
    name = next((e for e in names if (TRIED[e].onset == "must") == late), names[0])
    onset = part.onset_s - epoch_s if part.onset_s is not None and TRIED[name].onset != "never" else None
    return h.with_effect(name, (TRIED[name].starts or ((0.5, 0.5),))[0], onset)
