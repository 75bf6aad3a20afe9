"""Contenders of a search fitted to one part of the drives and judged by the rest, each part in turn.

The contenders are fitted anew to each part's other blocks, and those alone choose among them, as the search did among
all. What judges has chosen neither the effect nor its parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.answer.odds import prices
from avtorch.gap.chain.effect import EFFECTS, Effect
from avtorch.gap.heldout.chance_gains import chance_gains
from avtorch.gap.heldout.flexible import Flexible
from avtorch.gap.heldout.floor import Floor
from avtorch.gap.heldout.judged import Judge, Judged, unknown_by
from avtorch.gap.heldout.loop_measures import LoopMeasure, loop_measures
from avtorch.gap.heldout.parts import Part, drives_apart, parted
from avtorch.gap.heldout.refit import Refit
from avtorch.gap.heldout.rollout_errors import Measure, measures
from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.witnesses import judged
from avtorch.gap.search.found import Found, Race
from avtorch.gap.search.starts import of_effect

Float = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_RIVALS = 2  # besides the bare baseline and the verdict
_NEAR = 15.0  # nats behind the verdict, for more of which no part would choose another


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What the blocks that judge say of a `verdict`, every counted row once.

    - `sums` by name: `before` (the bare baseline), `after` (what the rest chose), `flexible` (a black box on top of
      that), `ceiling` (a black box on the bare baseline), `verdict`, `placebo` (the wrong effect `sham` on top of it);
      `fitted`: the verdict as all blocks fit it; `floor`: what that leaves over, as far as its parameters are known
    - `rows` (block,): how many single rows judge
    - `chosen`: share of the parts that chose the verdict; `by_chance`: it has no effect that a rollout could foretell;
      `by_drives`: whole drives are held out, not blocks of them
    """

    record: Record
    measures: Sequence[Measure | LoopMeasure]
    sums: Mapping[str, Judged]
    floor: Floor
    rows: Float
    chosen: float
    sham: type[Effect] | None
    by_chance: bool = False
    by_drives: bool = False


def held_out(
    race: Race,
    verdict: Found,
    *,
    blamed: bool = True,
    alike: Sequence[str] = (),
    progress: Progress | None = None,
) -> HeldOut | None:
    """Of a `verdict` among the finds of a search; None where the drives are too short to be parted.

    `blamed` False: it is the best of the named ones, and not the cause. `alike`: effects that no placebo may be, as
    they might be the cause as well.
    """
    record = race.record
    parts = parted(record)
    if not parts:
        return None
    price = prices(race.found)
    contenders = _contenders(race, verdict, price)
    sham = _sham(verdict, {*alike, *verdict.name.split("+")}, record.witnesses) if blamed else None
    bare = race.none.values
    kinds = (*measures(record.witnesses), *loop_measures(record.witnesses, bare["T_L"], bare["K_L"]))
    whole = Refit.whole(verdict)
    all_in = {f.name: chance_gains(f, race.raw, record) for f in contenders}
    # what a part cannot tell of chance is told by all: how much less its evidence is than the gain of its rows
    owed = {f.name: price[f.name] + all_in[f.name].sum() - _chance_evidence(f) for f in contenders}
    images = unknown_by(whole)
    told: dict[str, list[Judged]] = {}
    chosen, rows, floors = [], [], []
    for i, part in enumerate(parts):
        if progress is not None:
            progress("parts held out", i, len(parts))
        refits = [Refit.of(f, part.fits) for f in contenders]
        none, own = refits[0], next(r for r in refits if r.found is verdict)
        judge = Judge(record, part, kinds, none.values["T_L"])
        gains = {r.name: chance_gains(r.found, race.raw, part.fits) for r in refits}
        best = max(refits, key=lambda r: r.log_evidence + gains[r.name][~judge.inside].sum() - owed[r.name])
        chance = gains[best.name]
        boxes = {r.name: _foretold(r, part) for r in (none, best)}
        seen = {
            "before": judge.judged(none),
            "after": judge.judged(best, chance=chance),
            "fitted": judge.judged(whole, chance=all_in[verdict.name]),
            "flexible": judge.judged(best, less=boxes[best.name], chance=chance),
            "ceiling": judge.judged(none, less=boxes["none"]),
        }
        if sham is not None:
            seen |= {"verdict": judge.judged(own), "placebo": judge.judged(_with_sham(own, sham, part))}
        for name, values in seen.items():
            told.setdefault(name, []).append(values)
        floors.append(judge.floor(whole, images))
        chosen.append(best is own)
        rows.append(judge.rows)
    return HeldOut(
        record=record,
        measures=kinds,
        sums={name: Judged.joined(each) for name, each in told.items()},
        floor=Floor.joined(floors),
        rows=np.concatenate(rows),
        chosen=float(np.mean(chosen)),
        sham=sham,
        by_drives=bool(drives_apart(record)),
        by_chance=verdict.name != "none" and not verdict.candidate.effects,
    )


def _contenders(race: Race, verdict: Found, price: Mapping[str, float]) -> list[Found]:
    """The bare baseline first, the verdict, and what might take its place."""
    worth = {f.name: f.log_evidence - price[f.name] for f in race.found}
    others = [f for f in race.found if f is not verdict and f.name != "none"]
    near = [f for f in others if worth[f.name] > worth[verdict.name] - _NEAR]
    rivals = sorted(near, key=lambda f: -worth[f.name])[:_RIVALS]
    return [race.none, *([] if verdict is race.none else [verdict]), *rivals]


def _foretold(refit: Refit, part: Part) -> Float:
    """What a black box makes of a refit's errors."""
    record = refit.found.candidate.record
    return Flexible.of(record, record.measured - refit.errors).foretold(refit.errors, refit.white(part.fits))


def _chance_evidence(found: Found) -> float:
    own = found.by_chance.explained if found.by_chance else 0.0
    return own + (found.tails.evidence if found.tails else 0.0) + (found.losses.evidence if found.losses else 0.0)


def _sham(verdict: Found, taken: set[str], witnesses: tuple[str, ...]) -> type[Effect] | None:
    """A wrong effect with as many parameters as the verdict's, or nearly so: the first by name after the verdict's."""
    own = verdict.candidate.size - 2
    some = [e for e in EFFECTS.values() if not e.random and e.name not in taken and judged(e, witnesses)]
    some = [e for e in some if e.name not in _OF_THE_DRIVE]
    if not some:
        return None
    order = sorted(some, key=lambda e: (abs(len(e.parameters) - own), e.name <= verdict.name, e.name))
    return order[0]


_OF_THE_DRIVE = ("road_grade", "gear_shift", "gain_change")  # have many coefficients, or a moment of the drive


def _with_sham(refit: Refit, sham: type[Effect], part: Part) -> Refit:
    """The refit with the wrong effect on top, fitted to the same blocks."""
    found = refit.found
    candidate = Candidate(found.candidate.record, (*found.candidate.effects, sham), found.candidate.baseline)
    starts = of_effect(candidate, sham.name)
    z = candidate.z_of({**refit.values, **starts[len(starts) // 2]})
    return Refit.of(replace(found, name=candidate.name, candidate=candidate, z=z, onset=refit.onset), part.fits)
