"""The effect that enters a model next, with the effects that explain the same.

Score tests choose which effects are fitted; those fitted best are held out. Of the effects that explain the same, as
far as the blocks can tell, the simplest is added, and the others are its aliases; so is one that explains most of the
same with far fewer parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.held_out_evidence import MUCH
from avtorch.gap.budget.onset_search import ONSET_NATS, may_set_in, set_in
from avtorch.gap.budget.robust_fit import Fit, HeldOut, RobustFit
from avtorch.gap.budget.score_test import Candidate, ScoreTest
from avtorch.gap.budget.selection_step import Step, complexity, cost
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.observability import is_observable

LEAST_NATS = 3.0
"""In the blocks that fitted it, below which no effect is held out."""
_FAR_FEWER, _MOST_OF_IT = 3, 0.4  # parameters, and share of the gain, with which a simpler effect takes precedence
_FEW = 5.0  # degrees of freedom, from which blocks can agree
_OF_ITS_OWN = 0.5  # share of an effect's gain, on top of another, from which it is no alias of that
_FITTED = 9  # effects that are fitted, those of which a score test promises most
_SCREENING = 3  # iterations of these fits
_FAR_STARTS, _FAR_LAGS = 3, (-1.0, 0.0, 1.0)  # of the effect, and of the lag [prior SD]
_ORDINARY = 2.0  # prior SD, of gain and lag
_SCREENING_TURNS = 2  # of effect and onset
_SCREENED = 5  # effects that are held out, of those fitted


def observable(kinds: Iterable[type[Effect]], record: AnalysisRecord) -> list[type[Effect]]:
    """Those of `kinds` that predict something, and something that `record` measures."""
    return [kind for kind in kinds if not kind.random and is_observable(kind, record.channels)]


def candidates_for(
    fitting: RobustFit,
    now: Step,
    kinds: Sequence[type[Effect]],
    progress: Callable[[str, int, int], None] | None,
    role: str,
) -> list[Candidate]:
    """Those of `kinds` that `now` lacks, the most promising by a score test first."""
    test, names = ScoreTest.at(fitting, now.fit), now.fit.model.names
    candidates = []
    for kind in kinds:
        if kind.name in names:
            continue
        if progress is not None:
            progress(f"budget, {role}: {kind.name}", len(candidates), len(kinds) - len(names))
        candidate = test.candidate(kind)
        if may_set_in(candidate.model, kind.name):
            candidate = replace(candidate, late=test.late(candidate))
        candidates.append(candidate if kind.linear else _from_afar(fitting, now, candidate))
    return sorted(candidates, key=_promise, reverse=True)


def _from_afar(fitting: RobustFit, now: Step, candidate: Candidate) -> Candidate:
    """The candidate with one more start, away from the fit so far, where a short fit from there promises more.

    What clips or swallows commands hides gain and lag: of a car that never exceeds 0.3 m/s² the fit without saturation
    has a quarter of the gain, and next to it saturation changes nothing. Where gain and lag do not come out as those of
    an ordinary car, they were not hidden: a truck on a hilly road got a dead band with a lag of 12 s.
    """
    model = candidate.model
    starts = [
        model.coordinates({**model.named(start), "T_L": np.array([lag]), "K_L": np.array([0.0])})
        for start in candidate.starts[-_FAR_STARTS:]
        for lag in _FAR_LAGS
    ]
    fit = fitting.fit(model, np.clip(np.array(starts), model.low, model.high), iterations=_SCREENING)
    gain = now.fit.nats - fit.nats
    ordinary = all(abs(float(fit.known[key].item())) < _ORDINARY for key in ("T_L", "K_L"))
    if gain <= candidate.promise or not ordinary:
        return candidate
    return replace(candidate, starts=np.concatenate([fit.z[None], candidate.starts]), promise=gain)


def _promise(candidate: Candidate) -> float:
    """Of the effect from the start on, or of the onset that promises most [nats]."""
    late = candidate.late
    return candidate.promise if late is None else max(candidate.promise, late.promise - ONSET_NATS)


def enter(fitting: RobustFit, now: Step, candidates: Sequence[Candidate], least: float = LEAST_NATS) -> Step | None:
    """The best of `candidates` in, if the blocks that were held out agree on one.

    `least`: nats in the blocks that fit it, below which no effect is held out.
    """
    fits = [fitted(fitting, now, c, least) for c in candidates[:_FITTED]]
    fits = [fit for fit in fits if now.fit.nats - fit.nats > least]
    fits.sort(key=lambda fit: fit.nats + complexity(fit))
    tried = []
    for rough in fits[:_SCREENED]:
        fit = fitting.fit(rough.model, rough.z[None])
        name = fit.model.names[-1]
        if name in fit.model.onsets:
            fit = set_in(fitting, fit, name)
        if fit.model.at_limit(fit.z, name):
            continue
        held = fitting.hold_out(fit)
        if name in fit.model.onsets:
            fit, held = _from_the_start_or_not(fitting, fit, held)
        tried.append(Step(fit, held, name, fitting.evidence(now.held, held)))
    tried = [step for step in tried if step.evidence.of_entry > 0]
    if not tried:
        return None
    best = min(tried, key=cost)
    same = [s for s in tried if s is best or _explains_the_same(fitting, now, best, s)]
    chosen, alike = _simplest_alike(fitting, same)
    possible = [s for s in same if _possible_lag(s.fit)]
    if _possible_lag(chosen.fit):
        others = [s for s in possible if _much_simpler(now, chosen, s)]
    else:  # what such a lag gains needs blocks that agree
        others = [s for s in possible if fitting.preference(s.held, best.held).strength() <= 0]
    chosen = _simplest_alike(fitting, others or [chosen])[0]
    aliases = {s.entered for s in alike} | {chosen.entered}
    return replace(chosen, aliases=tuple(sorted(name for name in aliases if name is not None)))


def _simplest_alike(fitting: RobustFit, steps: Sequence[Step]) -> tuple[Step, list[Step]]:
    """The simplest, with a possible lag if one has it, of those of `steps` that are as good as the best; all those."""
    best = min(steps, key=cost)
    alike = [s for s in steps if s is best or not _surpasses(fitting, s.held, best.held)]
    return min([s for s in alike if _possible_lag(s.fit)] or alike, key=lambda s: complexity(s.fit)), alike


def _prefers(fitting: RobustFit, one: HeldOut, other: HeldOut) -> bool:
    """Whether blocks that were held out prefer `other` to `one`: they agree on that, or much is gained."""
    found = fitting.preference(one, other)
    return found.nats > MUCH or found.strength() > 0


def _surpasses(fitting: RobustFit, one: HeldOut, other: HeldOut) -> bool:
    """Whether these prefer `other`, which may be less simple: by much only where few of them excite the two.

    No agreement of two or three is sure enough. Of many that do not agree, each has something else to mend.
    """
    found = fitting.preference(one, other)
    return found.strength() > 0 or (found.nats > MUCH and found.freedom < _FEW)


def _from_the_start_or_not(fitting: RobustFit, fit: Fit, held: HeldOut) -> tuple[Fit, HeldOut]:
    """The fit, or one in which the last effect acts from the start, unless blocks that were held out prefer the onset.

    Where the effect from the start rests at a limit there is no such fit. A stretch with wilder noise than the rest
    would otherwise have an effect of its own. Few blocks lie between a wrong onset and the right one, so much that is
    gained counts as well as blocks that agree.
    """
    name = fit.model.names[-1]
    model = fit.model.without_onset(name)
    always = fitting.fit(model, model.coordinates(fit.known)[None])
    before = fitting.hold_out(always)
    return (fit, held) if _prefers(fitting, before, held) or model.at_limit(always.z, name) else (always, before)


def _explains_the_same(fitting: RobustFit, now: Step, best: Step, other: Step) -> bool:
    """Whether little is left of what the other explains once the best is in."""
    return fitting.on_top(now.held, best.held, other.held) < _OF_ITS_OWN * (cost(now) - cost(other))


def _possible_lag(fit: Fit) -> bool:
    """Whether the lag is one that a vehicle can have, and does not stand in for something else.

    A dead band with a lag of 12 s explains as much of a truck on a hilly road as the road, with far fewer parameters.
    """
    least, most = fit.model.plant.parameters()["T_L"].physical
    return least <= float(fit.model.values(fit.z)["T_L"]) <= most


def _much_simpler(now: Step, best: Step, other: Step) -> bool:
    """Whether the other explains most of the same with far fewer parameters.

    A free course of the road follows a constant force too, and whatever else comes back at the same place; what a
    simpler effect leaves of that, the flexible one may explain afterwards.
    """
    fewer = complexity(best.fit) - complexity(other.fit)
    return fewer >= _FAR_FEWER and cost(now) - cost(other) > _MOST_OF_IT * (cost(now) - cost(best))


def fitted(fitting: RobustFit, now: Step, candidate: Candidate, least: float = LEAST_NATS) -> Fit:
    """The candidate fitted, from the start on or from the onset that promises most.

    No onset is sought where neither of the two promises `least` nats: two fifths of a selection's time went there.
    """
    fit = fitting.fit(candidate.model, candidate.starts, iterations=_SCREENING)
    name, late = candidate.model.names[-1], candidate.late
    promises = max(now.fit.nats - fit.nats, -np.inf if late is None else late.promise - ONSET_NATS)
    if promises < least or not may_set_in(candidate.model, name):
        return fit
    later = set_in(fitting, fit, name, turns=_SCREENING_TURNS, iterations=_SCREENING)
    if late is not None and late.promise >= candidate.promise + ONSET_NATS:
        starts = np.concatenate([late.starts, late.model.coordinates(fit.known)[None]])
        other = fitting.fit(late.model, starts, iterations=_SCREENING)
        other = set_in(fitting, other, name, turns=_SCREENING_TURNS, iterations=_SCREENING)
        later = min(later, other, key=lambda f: f.nats)
    return later if later.nats + ONSET_NATS < fit.nats else fit
