"""The diagnosis: which effect the simulator lacks, with its probability, or that the cause is not in the table."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Literal

import numpy as np

from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.gap.engine.average import ModelAverage, Weight
from avtorch.gap.engine.coordinates import EFFECTS, adopt, base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import plant_of
from avtorch.gap.engine.inference import RANDOM, Inference, infer
from avtorch.gap.engine.priors import UNKNOWN_NATS
from avtorch.gap.engine.sample import sample
from avtorch.gap.result import sentences
from avtorch.gap.result.attribution import change_attribution, localise, row_attribution
from avtorch.gap.result.budget import MATERIAL, budget_of, families_of
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.gap.result.diagnosis import BlackBoxSimulator, Diagnosis
from avtorch.gap.result.free_form import fitted_form
from avtorch.gap.result.gap_size import Simulated, gap_size, shrinkage_of
from avtorch.gap.result.held_out import held_out_errors
from avtorch.gap.result.hypotheses import (
    ALIAS_RATIO,
    Scope,
    best_weight,
    candidates_of,
    first_onset,
    given_dead_time,
    parts_of,
    said_of_unnamed,
    unnamed_response,
    verdict,
    verdict_names,
)
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.result.parameters import ParameterPosterior, base_quantities, own_random, renamed
from avtorch.gap.result.predictive_model import predictive_models
from avtorch.gap.result.traces import Traces
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import Effect, chosen_effects
from avtorch.gap.simulator.effect_response import is_observable, lookalikes, not_observable
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io import LogSource, as_logs
from avtorch.io.mapping import Pairs


@shows_progress
def diagnose(
    logs: LogSource | Sequence[LogSource],
    *,
    map: Pairs = None,
    unit: Pairs = None,
    baseline: GapPlant | BlackBoxSimulator | str | PathLike[str] | None = None,
    prior: Mapping[str, float] | None = None,
    accel_kind: Literal["kinematic", "specific-force"] | None = None,
    effects: Sequence[str | type[Effect]] | None = None,
    pairs: bool = True,
    posterior: Literal["laplace", "sgld"] = "laplace",
    budget_s: float | None = None,
    material: float = MATERIAL,
    named_only: bool = False,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | bool | None = None,
) -> Diagnosis:
    """Name what `baseline` lacks on these drives of one car, and how much of the gap each effect contributes.

    One model of the car, its recorder and its noise gives the evidence of every set of effects that a search visits;
    the answer is their average (`avtorch.gap.engine`). Held-out blocks measure what the named causes take off.

    Args: `logs`: one log or several, each a `Log`, a path or a data frame; `map`, `unit`: names and units of the
    columns of those that are read here, as `Log.read` takes them.

    `baseline`: the user's simulator (default: bare GLVD); its effects keep their values, `T_L` and `K_L` are
    fitted. One that is not made of effects comes as an `avtorch.ExternalSimulator`. `prior`: weights over causes by
    name; those of `"pair"` for several at once. `effects`: those to test, by name or class (default: all registered).
    `pairs`: also test several at once. `posterior` of the verdict's parameters: by SGLD, or Laplace's approximation.
    `material`: share of the gap from which something counts. `budget_s`: after this time no new hypothesis is fitted;
    where that cuts the search short, `complete` is False and the verdict provisional: `scope` lists what was tested,
    and the verdict is distinguished only from that. `accel_kind`: whether `accel` is dv/dt or an accelerometer's
    reading (default: as the logs state). `progress(what, done, of)` is called at each step; True is a bar, False none,
    and None a bar in a notebook only.

    `named_only`: the repaired simulator has what is named alone. Else it also carries a force map or a resistance
    without a name, where that foretells blocks left out better than the names alone and than the baseline.

    Raises `InputError` for a log without `accel_cmd`, without a stretch of 12 s of usable driving, or for wrong
    arguments.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import SensorBias, plant
        >>> tilted = plant([SensorBias(0.3)], sigma=0.0)  # an accelerometer that reads 0.3 m/s² too much
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=tilted).log()
        >>> found = diagnose(log, effects=["dead_time", "sensor_bias"], pairs=False)
        >>> found.verdict.name, round(found.probability("dead_time"), 2)
        ('sensor_bias', 0.0)
    """
    given = called(progress)
    told = None if given is None else WholeProgress(given)
    each = as_logs(logs, map=map, unit=unit)
    if accel_kind is not None:
        if accel_kind not in ("kinematic", "specific-force"):
            raise InputError(f"accel_kind: found {accel_kind!r}, needs 'kinematic' or 'specific-force'")
        each = [replace(log, accel_kind=accel_kind) for log in each]
    if posterior not in ("laplace", "sgld"):
        raise InputError(f"posterior: found {posterior!r}, needs 'laplace' or 'sgld'")
    if not 0 < material < 1:
        raise InputError(f"material: found {material}, needs a share between 0 and 1")
    beside = None
    if isinstance(baseline, BlackBoxSimulator):
        beside = baseline.beside(each, given)
        each, baseline = list(beside.logs), beside.plant
    base = baseline if isinstance(baseline, GapPlant) else plant([], baseline=baseline)
    kinds = chosen_effects(effects)
    read = [with_sensor_noise(log) for log in each]
    each, notes = [log for log, _ in read], dict.fromkeys(note for _, note in read if note)
    data = DriveData.of(each)
    shown = [kind for kind in kinds if is_observable(kind, data.channels)]
    random = own_random(shown)
    inference = infer(
        data,
        baseline=base,
        effects=(*tried_names(shown), *(each.like for each in random)),
        most=None if pairs else 1,
        prior=checked_prior(prior, kinds),
        stop=deadline(budget_s),
        progress=told,
    )
    average = renamed(inference.average, random, {kind.name for kind in shown})
    none = inference.base
    rows = CountedRows.of(each, inference.data)
    epoch = each[int(rows.log[0])].epoch_s
    names = verdict_names(average)
    weight = best_weight(average, names)
    named = names[0] not in ("none", "unknown")
    draws = sample(weight.examined.hypothesis, seed=seed) if named and posterior == "sgld" else None
    chosen = ParameterPosterior(weight, draws, seed, random)
    candidates, posteriors = candidates_of(average, kinds, chosen if named else None, random)
    # an unknown cause shows where the best known ones would act
    mapped = weight.examined.hypothesis.force is not None
    top = weight if named or mapped or names == ("none",) else _likeliest(average)
    best = top.examined.hypothesis
    repaired = _without_map(weight)
    handed_back = ParameterPosterior(repaired, draws if repaired is weight else None, seed, random)
    if told is not None:
        told("held-out blocks", 0, 1)
    free = None if named_only else fitted_form(repaired.examined.hypothesis, base, none, named=named)
    visited = [h for h in inference.search.visited.values() if h.force is None]
    held = held_out_errors(none, repaired.examined.hypothesis, visited, free, named=named)
    free = free if held is None or held.free else None
    lag_and_gain, assumed = base_quantities(none, seed)
    alone = next(x for x in average.examined if x.hypothesis is none)
    simulator = plant([], baseline=plant_of(none, base), sigma=alone.compositions[0].slow.process_noise)
    back = handed_back.plant(base) if named else None
    belief, moved = handed_back.belief() if named else assumed, handed_back.moved()
    if free is not None:
        car = simulator if back is None else back
        back = free.beside(car)
        ratio = {"T_L": float(back.T_L) / float(car.T_L), "K_L": float(back.K_L) / float(car.K_L)}
        belief = {key: x * ratio.get(key, 1.0) for key, x in belief.items()}
        moved = {key: q.scaled(ratio[key]) for key, q in moved.items()}
    budget = None
    if held is not None:
        chance = [kind.name for kind in shown if kind.random]
        budget = budget_of(
            average, chosen, held, names=names, repaired=moved, chance=chance, material=material, seed=seed
        )
        names = budget.verdict
    complete = inference.search.complete
    known = "known effect" if complete and len(kinds) >= len(chosen_effects(None)) else "effect tried"
    said = verdict(average, names, known, partial=budget is not None and budget.partial)
    bearer = average.best.get("unknown", weight) if said.names == ("unknown",) else weight
    unnamed = unnamed_response(average, bearer, inference.search)
    nameless = ()
    if unnamed is not None:
        change = change_attribution(rows, unnamed.hypothesis, unnamed.change, UNKNOWN_NATS)
        nameless = localise(change, onset_s=None, lag=none["T_L"], epoch_s=epoch)
    parts = parts_of(average, said.names, chosen, seed, unnamed, nameless)
    if budget is not None and held is not None:
        families = families_of(average, chosen, parts, held, free, among=tried_names(shown), seed=seed)
        rest = replace(budget.unexplained, where=nameless, resembles=_resembles(average, said.names))
        budget = replace(budget, families=families, unexplained=rest if rest.material else budget.unexplained)
    if free is not None:
        whose = "Beside its names the" if named else "The"
        carries = f"{whose} repaired simulator carries {free.words}, without a name"
        notes[f"{carries}: on blocks left out it foretells more."] = None
    if told is not None:
        told("held-out blocks", 1, 1)
    hidden = not_observable(data.channels, kinds)
    alike = lookalikes(said.name, data.channels, specific_force=data.accel_kind == "specific-force", among=kinds)
    others = [*([] if complete else ["unknown"]), *sorted(alike)]  # unknown stands for what was not tried
    said = replace(
        said,
        alias_set=tuple(dict.fromkeys([*said.alias_set, *others])),
        why=f"{said.why} {said_of_unnamed(parts, said.abstained, each[0].epoch_s)}".strip(),
    )
    errors = [rows.errors(h) for h in (none, best, repaired.examined.hypothesis)]
    attribution = row_attribution(rows, best, none, (errors[0] - errors[1]).mean(-1))
    onset = None
    if names != ("none",):
        onset = first_onset(weight if named else top, names if named else top.label.split("+"))
    since = None if onset is None else onset.stamp_s - each[onset.log].epoch_s
    scope = _scope(inference, shown, data.channels, pairs)
    after = errors[2] if named else errors[0]
    if free is not None:
        after = rows.errors(free.lagged, free.without([]))
    answer = Diagnosis(
        log=LogFacts.of(each),
        baseline=lag_and_gain,
        gap=gap_size(
            rows,
            Simulated(errors[0], none["T_L"]),
            Simulated(errors[1], best["T_L"]),
            detected=average.probabilities["none"] < 0.5,
            p_value=attribution.p_value,
        ),
        candidates=tuple(candidates),
        verdict=said,
        onset_s=None if onset is None else onset.stamp_s,
        onset_log=0 if onset is None else onset.log,
        plant=back,
        simulator=simulator,
        belief=belief,
        assumed=assumed,
        draws=chosen.chains if named else None,
        where=() if names == ("none",) else localise(attribution, onset_s=since, lag=none["T_L"], epoch_s=epoch),
        shrinkage=shrinkage_of(held, seed) if held is not None and back is not None else None,
        contenders=predictive_models(posteriors, said, base),
        traces=Traces.of(rows, rows.measured - errors[0], rows.measured - after, attribution.does, each),
        remaining=given_dead_time(candidates, said, base),
        complete=complete,
        scope=scope,
        notes=(*notes, *([hidden] if hidden else []), *sentences.untried(scope)),
        budget=budget,
        parts=parts,
        free_form=None if free is None else free.effects(),
    )
    return answer if beside is None else beside.told(answer)


STEPS = 1000
"""Steps of a whole diagnosis."""

_SPANS: Mapping[str, tuple[float, float]] = {
    "recorder": (0.0, 0.1),
    "outliers": (0.1, 0.15),
    "effects": (0.15, 0.8),
    "average": (0.8, 0.9),
    "held-out blocks": (0.9, 1.0),
}


class WholeProgress:
    """Takes (what, done, of) of a stage; calls `progress` with the whole's instead, which never goes back."""

    def __init__(self, progress: Callable[[str, int, int], None]) -> None:
        self._progress = progress
        self._furthest = 0.0

    def __call__(self, what: str, done: int, of: int) -> None:
        begin, end = _SPANS.get(what, (0.0, 0.0))
        self._furthest = max(self._furthest, begin + (end - begin) * done / max(of, 1))
        self._progress(what, round(STEPS * self._furthest), STEPS)


def tried_names(kinds: Sequence[type[Effect]]) -> tuple[str, ...]:
    """Names by which the engine knows these effects, its variants of them among them."""
    known = [kind for kind in kinds if not kind.random or kind.name in (*RANDOM, "command_hold")]
    own = {kind.name if kind.random or kind.name in RANDOM else adopt(kind).name for kind in known}
    variants = [e for e in EFFECTS if base_name(e) in own or (e.startswith("~"))]
    return tuple(dict.fromkeys([*own, *variants]))


def checked_prior(prior: Mapping[str, float] | None, kinds: Sequence[type[Effect]]) -> Mapping[str, float] | None:
    """The user's weights. Raises `InputError` for other names, or weights that are negative or not finite."""
    allowed = {*(kind.name for kind in kinds), "none", "unknown", "pair"}
    for name, value in (prior or {}).items():
        if name not in allowed:
            raise InputError(f"prior: found {name!r}, needs one of {', '.join(sorted(allowed))}")
        if not (np.isfinite(value) and value >= 0):
            raise InputError(f"prior: found {value!r} for {name}, needs a weight of 0 or more")
    return prior


def deadline(budget_s: float | None) -> Callable[[], bool] | None:
    """A function that tells whether the time is over."""
    if budget_s is None:
        return None
    end = time.monotonic() + budget_s
    return lambda: time.monotonic() > end


def _likeliest(average: ModelAverage) -> Weight:
    """The strongest weight of a label with names."""
    named = [w for label, w in average.best.items() if label not in ("none", "unknown")]
    return max(named or average.best.values(), key=lambda w: w.log_weight)


def _resembles(average: ModelAverage, names: Sequence[str]) -> str | None:
    """The likeliest effect that is not named."""
    others = {n for label in average.probabilities for n in label.split("+")} - {"none", "unknown", *names}
    likely = [n for n in others if average.marginal(n) >= ALIAS_RATIO]
    return max(likely, key=lambda n: (average.marginal(n), n), default=None)


def _without_map(weight: Weight) -> Weight:
    """The weight with its hypothesis as the repaired simulator has it: fitted without a force map."""
    h = weight.examined.hypothesis
    if h.force is None:
        return weight
    return replace(weight, examined=replace(weight.examined, hypothesis=evaluate_evidence(fit(h.without_map(), 12))))


def _scope(inference: Inference, kinds: Sequence[type[Effect]], channels: Sequence[str], pairs: bool) -> Scope:
    """What was tried: everything that promised something was, unless the time was over."""
    complete = inference.search.complete
    visited = {base_name(e) for key in inference.search.visited for e, _ in key}
    tried = {k.name for k in kinds} if complete else visited | {k.name for k in kinds if k.random}
    own = {e.name: e for e in kinds}
    names = [n for n, e in {**own, **TABLE, **own}.items() if is_observable(e, channels)]
    return Scope(
        tuple(n for n in names if n in tried),
        tuple(n for n in names if n not in tried),
        "none" if not pairs else "all" if complete else "some",
    )
