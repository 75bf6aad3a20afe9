"""Cross-validation of a search: hypotheses are refitted without each fold in turn and scored on it.

The best hypothesis is selected anew in each fold from the other folds alone, as the search did with all data. A
held-out fold is thus used to select neither the effect nor its parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.blocks import Fold, folds, whole_drive_folds
from avtorch.gap.crossval.black_box import BlackBoxRegression
from avtorch.gap.crossval.closed_loop_errors import ClosedLoopMetric, closed_loop_metrics
from avtorch.gap.crossval.noise_floor import NoiseFloor
from avtorch.gap.crossval.random_effect_density import RandomEffectDensity
from avtorch.gap.crossval.refit import Refit
from avtorch.gap.crossval.scores import FoldScorer, FoldScores, parameter_spread
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.rollout_errors import RolloutMetric, rollout_metrics
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.search.initial_values import effect_starts
from avtorch.gap.selection.model_probabilities import complexity_penalties
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.observability import is_observable

Progress = Callable[[str, int, int], None]

_RIVALS = 2  # besides the bare baseline and the verdict
_NEAR = 15.0  # nats: no fold would select a hypothesis that is further behind the verdict


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Scores of a `verdict` on held-out blocks; every counted row is held out once.

    - `sums` by name: `before` (bare baseline), `after` (hypothesis selected without the fold), `flexible` (a black box
      on top of it), `ceiling` (a black box on the bare baseline), `verdict`, `placebo` (the wrong effect
      `placebo_effect` on top of it); `fitted`: the verdict fitted to all blocks. `floor`: its residual noise, with the
      uncertainty of its parameters
    - `rows` (block,): number of single rows per block
    - `chosen`: share of the folds that selected the verdict; `by_chance`: it has only random effects, which no rollout
      predicts; `by_drives`: the folds are whole drives, not blocks of them
    """

    record: Record
    metrics: Sequence[RolloutMetric | ClosedLoopMetric]
    sums: Mapping[str, FoldScores]
    floor: NoiseFloor
    rows: FloatArray
    chosen: float
    placebo_effect: type[Effect] | None
    by_chance: bool = False
    by_drives: bool = False


def cross_validate(
    race: SearchResult,
    verdict: FittedModel,
    *,
    alike: Sequence[str] = (),
    progress: Progress | None = None,
) -> CrossValidation | None:
    """Cross-validate a `verdict` among the fitted models of a search; None where the drives are too short to split.

    `alike`: effects excluded as placebo, because they may be the cause as well.
    """
    record = race.record
    parts = folds(record)
    if not parts:
        return None
    price = complexity_penalties(race.found)
    contenders = _contenders(race, verdict, price)
    placebo_effect = _placebo_effect(verdict, {*alike, *verdict.name.split("+")}, record.channels)
    bare = race.none.values
    kinds = (*rollout_metrics(record.channels), *closed_loop_metrics(record.channels, bare["T_L"], bare["K_L"]))
    whole = Refit.whole(verdict)
    densities = {f.name: RandomEffectDensity(f, race.raw) for f in contenders}
    all_in = {name: density(record) for name, density in densities.items()}
    # random effects are penalised alike in every fold: by their row gains less their evidence, over all rows
    owed = {f.name: price[f.name] + all_in[f.name].sum() - _chance_evidence(f) for f in contenders}
    images = parameter_spread(whole)
    scores: dict[str, list[FoldScores]] = {}
    chosen, rows, floors = [], [], []
    for i, part in enumerate(parts):
        if progress is not None:
            progress("held-out folds", i, len(parts))
        refits = [Refit.of(f, part.fits) for f in contenders]
        none, own = refits[0], next(r for r in refits if r.found is verdict)
        scorer = FoldScorer(record, part, kinds, none.values["T_L"])
        gains = {r.name: densities[r.name](part.fits) for r in refits}
        best = max(refits, key=lambda r: r.log_evidence + gains[r.name][~scorer.inside].sum() - owed[r.name])
        chance = gains[best.name]
        boxes = {r.name: _black_box_prediction(r, part) for r in (none, best)}
        results = {
            "before": scorer.score(none),
            "after": scorer.score(best, chance=chance),
            "fitted": scorer.score(whole, chance=all_in[verdict.name]),
            "flexible": scorer.score(best, less=boxes[best.name], chance=chance),
            "ceiling": scorer.score(none, less=boxes["none"]),
        }
        if placebo_effect is not None:
            results |= {"verdict": scorer.score(own), "placebo": scorer.score(_with_placebo(own, placebo_effect, part))}
        for name, values in results.items():
            scores.setdefault(name, []).append(values)
        floors.append(scorer.floor(whole, images))
        chosen.append(best is own)
        rows.append(scorer.rows)
    return CrossValidation(
        record=record,
        metrics=kinds,
        sums={name: FoldScores.joined(each) for name, each in scores.items()},
        floor=NoiseFloor.joined(floors),
        rows=np.concatenate(rows),
        chosen=float(np.mean(chosen)),
        placebo_effect=placebo_effect,
        by_drives=bool(whole_drive_folds(record)),
        by_chance=verdict.name != "none" and not verdict.hypothesis.effects,
    )


def _contenders(race: SearchResult, verdict: FittedModel, price: Mapping[str, float]) -> list[FittedModel]:
    """The bare baseline first, then the verdict and the hypotheses that may replace it."""
    net_evidence = {f.name: f.log_evidence - price[f.name] for f in race.found}
    others = [f for f in race.found if f is not verdict and f.name != "none"]
    near = [f for f in others if net_evidence[f.name] > net_evidence[verdict.name] - _NEAR]
    rivals = sorted(near, key=lambda f: -net_evidence[f.name])[:_RIVALS]
    return [race.none, *([] if verdict is race.none else [verdict]), *rivals]


def _black_box_prediction(refit: Refit, part: Fold) -> FloatArray:
    """A black box's prediction of a refit's errors."""
    record = refit.found.hypothesis.record
    return BlackBoxRegression.of(record, record.measured - refit.errors).predict(refit.errors, refit.white(part.fits))


def _chance_evidence(found: FittedModel) -> float:
    own = found.by_chance.explained if found.by_chance else 0.0
    return own + (found.tails.evidence if found.tails else 0.0) + (found.losses.evidence if found.losses else 0.0)


def _placebo_effect(verdict: FittedModel, taken: set[str], channels: tuple[str, ...]) -> type[Effect] | None:
    """A wrong effect with about as many parameters as the verdict has; ties go to the next name after the verdict's."""
    own = verdict.hypothesis.size - 2
    some = [e for e in EFFECTS.values() if not e.random and e.name not in taken and is_observable(e, channels)]
    some = [e for e in some if not e.of_the_drive]
    if not some:
        return None
    order = sorted(some, key=lambda e: (abs(len(e.parameters) - own), e.name <= verdict.name, e.name))
    return order[0]


def _with_placebo(refit: Refit, placebo_effect: type[Effect], part: Fold) -> Refit:
    """The refit with the wrong effect added, fitted to the same blocks."""
    found = refit.found
    hypothesis = Hypothesis(
        found.hypothesis.record, (*found.hypothesis.effects, placebo_effect), found.hypothesis.baseline
    )
    starts = effect_starts(hypothesis, placebo_effect.name)
    z = hypothesis.z_of({**refit.values, **starts[len(starts) // 2]})
    return Refit.of(replace(found, name=hypothesis.name, hypothesis=hypothesis, z=z, onset=refit.onset), part.fits)
