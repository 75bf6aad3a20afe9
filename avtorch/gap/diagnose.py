"""The diagnosis: which effect the simulator lacks, with what probability, or that none of the table's does it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Literal

from avtorch.errors import InputError
from avtorch.gap.answer import posterior as posteriors
from avtorch.gap.answer.aliases import Told
from avtorch.gap.answer.contender import contenders
from avtorch.gap.answer.diagnosis import Diagnosis, LogFacts
from avtorch.gap.answer.misfit import gap_facts
from avtorch.gap.answer.odds import favourite, probabilities
from avtorch.gap.answer.posterior import Draws
from avtorch.gap.answer.remainder import Remainder, remainder
from avtorch.gap.answer.remaining import remaining
from avtorch.gap.answer.reported import belief, drawn, moved, repaired, reported
from avtorch.gap.answer.traces import Traces
from avtorch.gap.answer.verdict import Candidate, verdict_of
from avtorch.gap.chain.effect import EFFECTS, Effect, effect_class
from avtorch.gap.chain.plant import GapPlant, plant
from avtorch.gap.heldout.held_out import held_out
from avtorch.gap.heldout.shown import Shown
from avtorch.gap.heldout.shrink import shrinkage
from avtorch.gap.heldout.where import where
from avtorch.gap.likelihood.as_read import as_read
from avtorch.gap.search.checkpoint import Checkpoint
from avtorch.gap.search.found import Found, Race
from avtorch.gap.search.search import Search
from avtorch.io import Log


def diagnose(
    logs: Log | Sequence[Log],
    *,
    baseline: GapPlant | str | PathLike[str] | None = None,
    prior: Mapping[str, float] | None = None,
    accel_kind: Literal["kinematic", "specific-force"] | None = None,
    effects: Sequence[str | type[Effect]] | None = None,
    pairs: bool = True,
    posterior: Literal["laplace", "sgld"] = "laplace",
    budget_s: float | None = None,
    seed: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
    checkpoint: Path | None = None,
) -> Diagnosis:
    """Name the effect, or the two, that `baseline` lacks on these drives of one car.

    Args: `baseline`: the user's simulator (default: bare GLVD); its effects keep their values, `T_L` and `K_L` are
    fitted. `prior`: weights over causes, see `odds.probabilities`. `effects`: candidates, by name or class (default:
    all registered). `pairs`: also try two at once. `posterior` of the verdict's parameters: by SGLD, or Laplace's
    approximation. `budget_s`: after so many seconds no new candidate is begun, and `complete` is False.
    `accel_kind`: whether `accel` is dv/dt or an accelerometer's reading (default: as the logs say).
    `progress(what, done, of)` is told of each step. `checkpoint`: a file in which fits are kept, and from which a
    search of the same logs and settings goes on.

    Raises `InputError` for a log without `accel_cmd`, without 10 s of usable driving, or for wrong arguments.
    """
    each = [logs] if isinstance(logs, Log) else list(logs)
    if accel_kind is not None:
        if accel_kind not in ("kinematic", "specific-force"):
            raise InputError(f"accel_kind: found {accel_kind!r}, needs 'kinematic' or 'specific-force'")
        each = [replace(log, accel_kind=accel_kind) for log in each]
    if posterior not in ("laplace", "sgld"):
        raise InputError(f"posterior: found {posterior!r}, needs 'laplace' or 'sgld'")
    read = [as_read(log) for log in each]
    each, noise_added = [log for log, _ in read], dict.fromkeys(note for _, note in read if note)
    base = baseline if isinstance(baseline, GapPlant) else plant([], baseline=baseline)
    kinds = [e if isinstance(e, type) else effect_class(e) for e in (EFFECTS.values() if effects is None else effects)]
    race = Search(
        each, base, effects=kinds, pairs=pairs, budget_s=budget_s, progress=progress, checkpoint=Checkpoint(checkpoint)
    ).run()
    top = favourite(race.found)
    apart = Told.of(race, kinds, prior)
    chances = apart.shared(probabilities(race.found, _left(top, race), prior))
    candidates = [_told(f, race, chances[f.name]) for f in race.found]
    candidates.append(Candidate("unknown", chances["unknown"], None, {}, {}, None))
    candidates += apart.mirrored(candidates, chances)
    verdict = verdict_of(candidates, aliases=apart.alias_set)
    winner = next((f for f in race.found if f.name == verdict.name), None)
    draws = None
    if winner is not None and winner.candidate.size and winner.name != "none" and posterior == "sgld":
        draws = _draws(winner, seed)
        told = _told(winner, race, chances[winner.name], draws)
        candidates = [told if c.name == winner.name else c for c in candidates]
    noted = tuple(noise_added)
    if not race.complete:
        noted += ("The budget ended the search before all candidates were tried.",)
    if draws is not None and draws.method != "sgld":
        noted += (f"The parameters' posterior is by {draws.method}: {draws.why}.",)
    if apart.note is not None:
        noted += (apart.note,)
    named = winner is not None and winner.name != "none"
    # what is unknown sets in where the best of the named ones does
    onset = None if verdict.name == "none" else _onset(winner or top, race)
    alike = {part for name in verdict.alias_set for part in name.split("+")}
    held = held_out(race, winner or top, blamed=named, alike=sorted(alike), progress=progress)
    shown = Shown.of(race, winner or top)
    return Diagnosis(
        log=LogFacts.of(each),
        baseline=moved(race.none),
        gap=gap_facts(race, top, detected=chances["none"] < 0.5, p_value=shown.p_value),
        candidates=tuple(candidates),
        verdict=verdict,
        onset_s=onset,
        plant=repaired(winner, base, draws) if named and winner is not None else None,
        simulator=repaired(race.none, base),
        belief=belief(winner if named and winner is not None else race.none, draws if named else None),
        assumed=belief(race.none),
        draws=drawn(winner, draws) if draws is not None and winner is not None else None,
        where=() if verdict.name == "none" else where(shown, onset_s=onset, lag=race.none.values["T_L"]),
        shrinkage=shrinkage(held) if held is not None and named else None,
        contenders=contenders(race, verdict),
        traces=_traces(race, winner, shown),
        remaining=remaining(candidates, verdict, base),
        complete=race.complete,
        notes=noted,
    )


def _left(top: Found, race: Race) -> Remainder:
    """What the favourite leaves over, less what lost messages explain row by row."""
    measured = race.record.measured
    explained = top.losses.evidence if top.losses else 0.0
    return remainder(top.white, top.errors, measured - top.errors, explained=explained)


def _traces(race: Race, winner: Found | None, shown: Shown) -> Traces:
    record = race.record
    measured = record.measured.mean(-1)
    after = race.none if winner is None else winner
    return Traces(
        time=record.time[record.source],
        command=record.command[record.source],
        witnesses=record.witnesses,
        measured=measured,
        before=measured - race.none.errors.mean(-1),
        after=measured - after.errors.mean(-1),
        does=shown.does,
        stretch=record.stretch,
    )


def _draws(found: Found, seed: int) -> Draws:
    return posteriors.posterior(found, seed=seed)


def _told(found: Found, race: Race, probability: float, draws: Draws | None = None) -> Candidate:
    """A candidate as the answer lists it; parameters only where they bear on anything."""
    gain = float(found.log_evidence - race.none.log_evidence)
    if found.name == "none" or probability < 1e-4:
        return Candidate(found.name, probability, gain, {}, {}, None)
    return Candidate(
        found.name, probability, gain, reported(found, draws), moved(found, draws), _onset(found, race)
    )  # fmt: skip


def _onset(found: Found | None, race: Race) -> float | None:
    """On the log's own time axis [s]; of a change of gain the moment of the change."""
    if found is None:
        return None
    if found.name == "gain_change":
        return float(found.values["gain_change.change_s"])
    if found.name == "outliers" and found.tails is not None and found.tails.onset is not None:
        return float(race.raw.time[race.raw.source[found.tails.onset]])
    if found.name == "command_hold" and found.losses is not None and found.losses.onset is not None:
        return float(race.raw.time[race.raw.source[found.losses.onset]])
    return None if found.began is None else float(race.record.time[race.record.source[found.began]])
