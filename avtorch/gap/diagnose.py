"""The diagnosis: which effect the simulator lacks, with its probability, or that the cause is not in the table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Literal

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.gap.answer.budget import MATERIAL, Budget
from avtorch.gap.answer.given_dead_time import given_dead_time
from avtorch.gap.answer.location import RowAttribution, localise
from avtorch.gap.answer.plausibility import implausible
from avtorch.gap.answer.verdict import Candidate, Verdict, verdict_of
from avtorch.gap.black_box import BlackBoxSimulator
from avtorch.gap.budget.account import account, divisible, restated
from avtorch.gap.budget.forward_selection import MOST_PARTS
from avtorch.gap.budget.repaired_model import parameter_draws, repaired_plant, with_chance
from avtorch.gap.budget.shrinkage import shrinkage_of
from avtorch.gap.crossval.attribution import row_attribution
from avtorch.gap.crossval.cross_validate import cross_validate
from avtorch.gap.crossval.gap_closed import gap_closed
from avtorch.gap.drive_record import Record
from avtorch.gap.posterior import sample as posteriors
from avtorch.gap.posterior.draws import Draws
from avtorch.gap.posterior.summary import belief, lag_and_gain, repaired, reported, reported_draws
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis, LogFacts
from avtorch.gap.result.gap_size import gap_size
from avtorch.gap.result.predictive_model import predictive_models
from avtorch.gap.result.rival_models import noise_left, rival_models
from avtorch.gap.result.traces import Traces
from avtorch.gap.result.uncounted import uncounted
from avtorch.gap.rollout_errors import rolled_out
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.search.search import Search
from avtorch.gap.selection import periodic_commands as delays
from avtorch.gap.selection.adequacy import Adequacy, adequacy
from avtorch.gap.selection.aliases import Identifiability
from avtorch.gap.selection.model_probabilities import favourite, model_probabilities
from avtorch.gap.sensor_noise import with_sensor_noise
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.effect_choice import chosen_effects
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.whole_progress import WholeProgress
from avtorch.io import Log, LogSource, as_logs
from avtorch.io.mapping import Pairs

# Probability of an unknown cause after the best single effect, from which held-out blocks decide without any pair: in
# 36 simulated logs pairs brought it below a half from 0.98 at most; behind most ordinary recorders it is above 0.99.
_LOST = 0.99
_NO_PAIRS = (
    "The likelihood tried no pairs: its noise does not hold for this log with the best single effect, so held-out "
    "blocks select the effects, any number of them."
)


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
    seed: int = 0,
    progress: Callable[[str, int, int], None] | bool | None = None,
    checkpoint: str | PathLike[str] | None = None,
) -> Diagnosis:
    """Name what `baseline` lacks on these drives of one car, and how much of the gap each effect contributes.

    The likelihood's verdict holds where it names something. Where it is `unknown`, effects are selected on held-out
    blocks under noise of any spectrum: any number of them.

    Args: `logs`: one log or several, each a `Log`, a path or a data frame; `map`, `unit`: names and units of the
    columns of those that are read here, as `Log.read` takes them.

    `baseline`: the user's simulator (default: bare GLVD); its effects keep their values, `T_L` and `K_L` are
    fitted. One that is not made of effects comes as an `avtorch.ExternalSimulator`. `prior`: weights over causes, see
    `model_probabilities`. `effects`: those to test, by name or class (default: all registered). `pairs`: also test
    several at once. `posterior` of the verdict's parameters: by SGLD, or Laplace's approximation. `material`: share of
    the gap from which something counts. `budget_s`: after this time no new hypothesis is fitted; where that cuts the
    search short, `complete` is False and the verdict provisional: `scope` lists what was tested, and the verdict is
    distinguished only from that. `accel_kind`: whether `accel` is dv/dt or an accelerometer's reading (default: as the
    logs state). `progress(what, done, of)` is called at each step, with `done` of `of` in the whole diagnosis;
    True is a bar, False none, and None a bar in a notebook only. `checkpoint`: a file that stores what is finished; a
    later search of the same logs with the same settings continues from it, to the same answer.

    Raises `InputError` for a log without `accel_cmd`, without 10 s of usable driving, for wrong arguments, or for a
    `checkpoint` that is damaged or belongs to other logs or settings.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import SensorBias, plant
        >>> tilted = plant([SensorBias(0.3)], sigma=0.0)  # an accelerometer that reads 0.3 m/s² too much
        >>> log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=tilted).log()
        >>> found = diagnose(log, effects=["dead_time", "sensor_bias"], pairs=False)
        >>> found.verdict.name, round(found.probability("dead_time"), 2)
        ('sensor_bias', 0.0)
    """
    told = called(progress)
    stages = None if told is None else WholeProgress(told)
    each = as_logs(logs, map=map, unit=unit)
    if accel_kind is not None:
        if accel_kind not in ("kinematic", "specific-force"):
            raise InputError(f"accel_kind: found {accel_kind!r}, needs 'kinematic' or 'specific-force'")
        each = [replace(log, accel_kind=accel_kind) for log in each]
    if posterior not in ("laplace", "sgld"):
        raise InputError(f"posterior: found {posterior!r}, needs 'laplace' or 'sgld'")
    if not 0 < material < 1:
        raise InputError(f"material: found {material}, needs a share between 0 and 1")
    if isinstance(baseline, BlackBoxSimulator):
        beside = baseline.beside(each, stages)
        found = diagnose(
            beside.logs,
            baseline=beside.plant,
            prior=prior,
            effects=effects,
            pairs=pairs,
            posterior=posterior,
            budget_s=budget_s,
            material=material,
            seed=seed,
            progress=told or False,
            checkpoint=checkpoint,
        )
        return beside.told(found)
    measured, read = each, [with_sensor_noise(log) for log in each]
    each, noise_added = [log for log, _ in read], dict.fromkeys(note for _, note in read if note)
    base = baseline if isinstance(baseline, GapPlant) else plant([], baseline=baseline)
    kinds = chosen_effects(effects)
    search = Search(
        each,
        base,
        effects=kinds,
        pairs=pairs,
        lost=(lambda singles, record: _unknown(singles, record, prior) > _LOST) if divisible(measured) else None,
        budget_s=budget_s,
        progress=stages,
        checkpoint=checkpoint,
    )
    race = search.run()
    top = favourite(race.found)
    apart = Identifiability.of(race, kinds, prior)
    chances = apart.shared(model_probabilities(race.found, left_over(top, race.record), prior))
    undetermined = delays.undetermined_delays(race.found)
    chances = delays.shared(chances, undetermined)
    candidates = [_candidate(f, race, chances[f.name], kinds) for f in race.found]
    # for an unknown cause the only model is the bare baseline
    bare = implausible({}, lag_and_gain(race.none))
    candidates.append(Candidate("unknown", chances["unknown"], None, {}, {}, None, bare))
    candidates += apart.mirrored(candidates, chances)
    known = "known effect" if race.complete and race.scope.whole else "effect tried"
    verdict = verdict_of(
        candidates,
        aliases=lambda c: delays.add_delay_aliases(apart.alias_set(c), undetermined),
        why=delays.why(chances, undetermined),
        known=known,
    )
    won = next((f for f in race.found if f.name == verdict.name), None)
    accounted = account(
        measured,
        base,
        kinds,
        candidates,
        verdict,
        won,
        material=material,
        most=(MOST_PARTS if pairs else 1) if race.complete else 0,
        seed=seed,
        progress=stages,
        checkpoint=search.fits.checkpoint,
    )
    if accounted is not None:
        candidates, verdict = list(accounted.candidates), accounted.verdict
        if not race.complete and "unknown" not in verdict.alias_set:  # which stands for what was not tried
            verdict = replace(verdict, alias_set=(*verdict.alias_set, "unknown"))
    budget = None if accounted is None else accounted.budget
    selected = accounted.selection if accounted is not None and accounted.held_out else None
    winner = None if selected is not None else next((f for f in race.found if f.name == verdict.name), None)
    draws = None
    one_mode = winner is not None and (winner.delays is None or len(winner.delays.lengths) == 1)
    if winner is not None and winner.hypothesis.size and winner.name != "none" and posterior == "sgld" and one_mode:
        draws = _draws(winner, seed)
        anew = _candidate(winner, race, chances[winner.name], kinds, draws)
        candidates = [anew if c.name == winner.name else c for c in candidates]
        budget = None if budget is None else restated(budget, anew)
    noted = tuple(noise_added)
    if not race.complete:
        noted += ("The budget ended the search before all hypotheses were tried: the verdict is provisional.",)
    noted += tuple(sentences.untried(race.scope))
    if race.scope.pairs == "lost":
        noted += (_NO_PAIRS,)
    noted += tuple(delays.notes(race.found, verdict))
    if posterior == "sgld" and not one_mode and winner is not None:
        noted += (
            "The parameters' posterior is by laplace: it has several modes, and no chain would cross between them.",
        )
    if draws is not None and draws.method != "sgld":
        noted += (f"The parameters' posterior is by {draws.method}: {draws.why}.",)
    if apart.note is not None:
        noted += (apart.note,)
    named = winner is not None and winner.name != "none"
    # an unknown cause gets the onset of the most probable named effect
    onset = None if verdict.name == "none" or selected is not None else _onset(winner or top, race)
    if selected is not None and budget is not None:
        onset = _of_the_only_part(budget, verdict, each)
    alike = {part for name in verdict.alias_set for part in name.split("+")}
    # where nothing is named, no effect closes anything
    held = cross_validate(race, winner, alike=sorted(alike), progress=stages) if named and winner else None
    attribution = row_attribution(race, winner or top)
    car, beliefs = None, belief(race.none)
    shrinkage = None if held is None else gap_closed(held)
    contenders, errors = predictive_models(race, verdict), (race.none if winner is None else winner).errors
    if named and winner is not None:
        car, beliefs = repaired(winner, base, draws), belief(winner, draws)
    elif selected is not None and budget is not None and budget.names:
        car, beliefs = repaired_plant(selected, base), parameter_draws(selected, seed=seed)
        errors = _errors(each, race.record, car, budget)
        noise = noise_left(race.record, errors, race.none.noise.noise, car, budget)
        car = with_chance(car, budget, kinds, noise)
        if budget.parts:  # no rollout shows what chance decides
            shrinkage = shrinkage_of(selected)
            contenders = rival_models(
                selected,
                budget,
                verdict,
                base,
                kinds,
                noise=noise,
                probability=next(c.probability for c in candidates if c.name == verdict.name),
                specific_force=race.record.accel_kind == "specific-force",
                seed=seed,
            )
    return Diagnosis(
        log=LogFacts.of(each),
        baseline=lag_and_gain(race.none),
        gap=gap_size(race, top, detected=chances["none"] < 0.5, p_value=attribution.p_value),
        candidates=tuple(candidates),
        verdict=verdict,
        onset_s=None if onset is None else onset.stamp_s,
        onset_from_start_s=None if onset is None else onset.from_start_s,
        onset_log=0 if onset is None else onset.log,
        plant=car,
        simulator=repaired(race.none, base),
        belief=beliefs,
        assumed=belief(race.none),
        draws=reported_draws(winner, draws) if draws is not None and winner is not None else None,
        where=()
        if verdict.name == "none"
        else localise(attribution, onset_s=None if onset is None else onset.from_start_s, lag=race.none.values["T_L"]),
        shrinkage=shrinkage,
        contenders=contenders,
        traces=_traces(each, race, errors, attribution),
        remaining=given_dead_time(candidates, verdict, base),
        complete=race.complete,
        scope=race.scope,
        notes=noted,
        budget=budget,
    )


def left_over(top: FittedModel, record: Record) -> Adequacy:
    """Structure left in the residuals of the most probable hypothesis, less what lost messages explain row by row."""
    explained = (top.losses.evidence if top.losses else 0.0) + (top.by_chance.explained if top.by_chance else 0.0)
    return adequacy(top.white, top.errors, record.measured - top.errors, explained=explained)


def _unknown(found: Sequence[FittedModel], record: Record, prior: Mapping[str, float] | None) -> float:
    """Probability that none of these hypotheses is the cause."""
    return model_probabilities(found, left_over(favourite(found), record), prior)["unknown"]


def _errors(logs: Sequence[Log], record: Record, car: GapPlant, budget: Budget) -> FloatArray:
    """Errors (channel, counted, group) of the simulator with the parts of a budget, each from its onset on."""
    late = {p.name: p.onset_s - logs[0].epoch_s for p in budget.parts if p.onset_s is not None}
    return record.measured - rolled_out(record, car, late)


def _traces(logs: Sequence[Log], race: SearchResult, errors: FloatArray, attribution: RowAttribution) -> Traces:
    """`errors` (channel, counted, group): of the simulator with what was named."""
    record = race.record
    measured = record.measured.mean(-1)
    return Traces(
        time=record.time[record.source],
        command=record.command[record.source],
        channels=record.channels,
        measured=measured,
        before=measured - race.none.errors.mean(-1),
        after=measured - errors.mean(-1),
        does=attribution.does,
        stretch=record.stretch,
        uncounted=uncounted(logs, record),
    )


def _draws(found: FittedModel, seed: int) -> Draws:
    return posteriors.posterior(found, seed=seed)


def _candidate(
    found: FittedModel,
    race: SearchResult,
    probability: float,
    kinds: Sequence[type[Effect]],
    draws: Draws | None = None,
) -> Candidate:
    """A hypothesis as listed in the answer; its parameters only where they are relevant."""
    gain = float(found.log_evidence - race.none.log_evidence)
    if found.name == "none":
        return Candidate("none", probability, gain, {}, {}, None, implausible({}, lag_and_gain(found)))
    if probability < 1e-4:
        return Candidate(found.name, probability, gain, {}, {}, None)
    parameters, base = reported(found, draws), lag_and_gain(found, draws)
    own = [kind for kind in kinds if kind.name in found.name.split("+")]
    odd = implausible(parameters, base, own)
    onset = _onset(found, race)
    began = None if onset is None else onset.stamp_s
    return Candidate(found.name, probability, gain, parameters, base, began, odd)


@dataclass(frozen=True)
class _Onset:
    """A time in log number `log`: `stamp_s` on the log's own clock, `from_start_s` from its first row [s]."""

    stamp_s: float
    from_start_s: float
    log: int

    @classmethod
    def at(cls, record: Record, row: int, time: float | None = None) -> _Onset:
        """The time of a counted `row`, or a given `time` [s from the start] near that row."""
        place = record.source[row]
        start = float(record.time[place]) if time is None else time
        stamp = float(record.stamp[place]) if time is None else start + float(record.stamp[place] - record.time[place])
        return cls(stamp, start, int(record.log[place]))


def _of_the_only_part(budget: Budget, verdict: Verdict, logs: Sequence[Log]) -> _Onset | None:
    """The onset of the part that held-out blocks selected, where it is the whole verdict; of several each has one."""
    found = next((part.onset_s for part in budget.parts if (part.name,) == tuple(verdict.names)), None)
    return None if found is None else _Onset(found, found - logs[0].epoch_s, 0)


def _onset(found: FittedModel | None, race: SearchResult) -> _Onset | None:
    """The onset of a fitted model: the effect's own onset parameter where it has one."""
    if found is None:
        return None
    own = found.hypothesis.effects[0] if len(found.hypothesis.effects) == 1 else None
    if own is not None and own.own_onset is not None and found.name == own.name:
        change = float(found.values[f"{own.name}.{own.own_onset}"])
        row = int(np.abs(race.record.time[race.record.source] - change).argmin())
        return _Onset.at(race.record, row, change)
    alone = bool(found.searched) and found.name == found.searched[-1].name
    if alone and found.tails is not None and found.tails.onset is not None:
        return _Onset.at(race.raw, found.tails.onset)
    if alone and found.losses is not None and found.losses.onset is not None:
        return _Onset.at(race.raw, found.losses.onset)
    return None if found.began is None else _Onset.at(race.record, found.began)
