"""How far the gap shrinks: before, after, floor and placebo on blocks that chose neither effect nor parameters.

The contenders of a search are fitted anew to each part's other blocks, and those alone choose among them, as the search
did among all. The floor is what the verdict leaves where all drives fit its parameters, and what it takes to know them
no better than that; or what a flexible regression leaves, where it is below by more than chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.answer.odds import prices
from avtorch.gap.answer.quantity import Quantity
from avtorch.gap.answer.shrinkage import Closed, Shrinkage
from avtorch.gap.chain.effect import EFFECTS, Effect
from avtorch.gap.heldout.chance_gains import chance_gains
from avtorch.gap.heldout.flexible import Flexible
from avtorch.gap.heldout.judged import Judge, Judged
from avtorch.gap.heldout.parts import Part, parted
from avtorch.gap.heldout.refit import Refit
from avtorch.gap.heldout.rollout_errors import USUAL, Measure, measures
from avtorch.gap.likelihood.candidate import Candidate
from avtorch.gap.likelihood.witnesses import judged
from avtorch.gap.search.found import Found, Race
from avtorch.gap.search.starts import of_effect

Float = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

DENSITY = "log_predictive_density"
_RIVALS = 2  # besides the bare baseline and the verdict
_NEAR = 15.0  # nats behind the verdict, for more of which no part would choose another
_DRAWS = 2000  # of blocks, with replacement
_TELLS = 1.1  # before over floor, for less of which there is nothing to close
_TELLS_NATS = 5.0  # likewise of densities, over all blocks


def shrinkage(
    race: Race, verdict: Found, *, alike: Sequence[str] = (), progress: Progress | None = None
) -> Shrinkage | None:
    """Of a `verdict` among the finds of a search; None where the drives are too short to be parted.

    `alike`: effects that no placebo may be, as they might be the cause as well.
    """
    record = race.record
    parts = parted(record)
    if not parts:
        return None
    price = prices(race.found)
    worth = {f.name: f.log_evidence - price[f.name] for f in race.found}
    near = [
        f for f in race.found if f is not verdict and f.name != "none" and worth[f.name] > worth[verdict.name] - _NEAR
    ]
    contenders = [race.none, verdict, *sorted(near, key=lambda f: -worth[f.name])[:_RIVALS]]
    sham = _sham(verdict, {*alike, *verdict.name.split("+")}, record.witnesses)
    kinds = measures(record.witnesses)
    whole = Refit.whole(verdict)
    all_in = {f.name: chance_gains(f, race.raw, record) for f in contenders}
    # what a part cannot tell of chance is told by all: how much less its evidence is than the gain of its rows
    owed = {f.name: price[f.name] + all_in[f.name].sum() - _chance_evidence(f) for f in contenders}
    told: dict[str, list[Judged]] = {}
    chosen, rows = [], []
    for i, part in enumerate(parts):
        if progress is not None:
            progress("parts held out", i, len(parts))
        refits = [Refit.of(f, part.fits) for f in contenders]
        none = refits[0]
        judge = Judge(record, part, kinds, none.values["T_L"])
        gains = {r.name: chance_gains(r.found, race.raw, part.fits) for r in refits}
        best = max(refits, key=lambda r: r.log_evidence + gains[r.name][~judge.rows_inside].sum() - owed[r.name])
        chosen.append(best.name == verdict.name)
        rows.append(judge.rows)
        chance = gains[best.name]
        seen = {"before": judge.judged(none), "after": judge.judged(best, chance=chance)}
        seen |= {"fitted": judge.judged(whole, chance=all_in[verdict.name]), "owed": judge.owed(whole)}
        for name, of in (("flexible", best), ("ceiling", none)):
            fits = of.white(part.fits)
            more = Flexible.of(record, record.measured - of.errors).foretold(of.errors, fits)
            seen[name] = judge.judged(of, less=more, chance=chance if of is best else None)
        if sham is not None:
            seen["placebo"] = judge.judged(_with_sham(refits[1], sham, part))
            seen["verdict"] = judge.judged(refits[1])
        for name, values in seen.items():
            told.setdefault(name, []).append(values)
    sums = {name: Judged.joined(each) for name, each in told.items()}
    return _summed(sums, np.concatenate(rows), kinds, float(np.mean(chosen)), sham)


def _summed(
    sums: dict[str, Judged], rows: Float, kinds: Sequence[Measure], chosen: float, sham: type[Effect] | None
) -> Shrinkage:
    rng = np.random.default_rng(0)
    blocks = len(rows)
    drawn = rng.multinomial(blocks, np.full(blocks, 1 / blocks), size=_DRAWS).astype(float)
    weights = np.concatenate([np.ones((1, blocks)), drawn])

    by_metric, placebos, ceiling = {}, {}, {}
    for k, measure in enumerate(kinds):
        square = {name: s.squares[k] for name, s in sums.items()}
        floor = _floor(square["fitted"] + square["owed"], square["flexible"], below=True)
        total = {name: np.sqrt(weights @ x / (weights @ rows)) for name, x in square.items()}
        total["floor"] = np.sqrt(np.maximum(weights @ floor, 0.0) / (weights @ rows))
        tells = total["before"][0] > _TELLS * total["floor"][0]
        by_metric[measure.name] = _closed(total, tells)
        placebos[measure.name] = _placebo(total, tells)
        ceiling[measure.name] = float(total["ceiling"][0])
    nats = {name: s.nats for name, s in sums.items()}
    best = _floor(nats["fitted"] - nats["owed"], nats["flexible"], below=False)
    total = {name: weights @ x / (weights @ rows) for name, x in nats.items()}
    total["floor"] = weights @ best / (weights @ rows)
    tells = (total["floor"][0] - total["before"][0]) * rows.sum() > _TELLS_NATS
    by_metric[DENSITY] = _closed(total, tells)
    placebos[DENSITY] = _placebo(total, tells)
    ceiling[DENSITY] = float(total["ceiling"][0])
    usual = [m.name for m in kinds if m.horizon_s == USUAL[m.witness]]
    shows = {name: by_metric[name].before / max(by_metric[name].floor, 1e-12) for name in usual}
    metric = max(shows, key=lambda name: shows[name])
    if shows[metric] < _TELLS:
        metric = DENSITY
    return Shrinkage(
        metric=metric,
        by_metric=by_metric,
        placebo_effect=None if sham is None else sham.name,
        placebo=placebos[metric],
        ceiling=ceiling,
        chosen=chosen,
        blocks=blocks,
    )


def _chance_evidence(found: Found) -> float:
    return (found.tails.evidence if found.tails else 0.0) + (found.losses.evidence if found.losses else 0.0)


def _floor(model: Float, flexible: Float, *, below: bool) -> Float:
    """(block,): the flexible regression's where it beats the model by more than blocks differ."""
    gain = (model - flexible) if below else (flexible - model)
    if len(gain) > 1 and gain.mean() > 1.645 * gain.std(ddof=1) / np.sqrt(len(gain)):
        return flexible
    return model


def _closed(total: dict[str, Float], tells: bool) -> Closed:
    """From values (draw,), the first of all blocks once."""
    share = _share(total["before"] - total["after"], total["before"] - total["floor"]) if tells else None
    before, after, floor = (float(total[name][0]) for name in ("before", "after", "floor"))
    return Closed(before, after, floor, share)


def _placebo(total: dict[str, Float], tells: bool) -> Quantity | None:
    if not tells or "placebo" not in total:
        return None
    return _share(total["verdict"] - total["placebo"], total["before"] - total["floor"])


def _share(part: Float, whole: Float) -> Quantity:
    draws = part[1:] / np.where(np.abs(whole[1:]) > 1e-12, whole[1:], np.nan)
    draws = draws[np.isfinite(draws)]
    q05, q95 = np.quantile(draws, (0.05, 0.95))
    mean = float(part[0] / whole[0])
    return Quantity(mean, float(draws.std()), min(float(q05), mean), max(float(q95), mean))


def _sham(verdict: Found, taken: set[str], witnesses: tuple[str, ...]) -> type[Effect] | None:
    """A wrong effect with as many parameters as the verdict's, or nearly so: the first by name after the verdict's."""
    own = verdict.candidate.size - 2
    some = [e for e in EFFECTS.values() if not e.random and e.name not in taken and judged(e, witnesses)]
    some = [e for e in some if e.name not in ("road_grade", "gear_shift", "gain_change")]
    if not some:
        return None
    order = sorted(some, key=lambda e: (abs(len(e.parameters) - own), e.name <= verdict.name, e.name))
    return order[0]


def _with_sham(refit: Refit, sham: type[Effect], part: Part) -> Refit:
    """The refit with the wrong effect on top, fitted to the same blocks."""
    found = refit.found
    candidate = Candidate(found.candidate.record, (*found.candidate.effects, sham), found.candidate.baseline)
    starts = of_effect(candidate, sham.name)
    z = candidate.z_of({**refit.values, **starts[len(starts) // 2]})
    return Refit.of(replace(found, name=candidate.name, candidate=candidate, z=z, onset=refit.onset), part.fits)
