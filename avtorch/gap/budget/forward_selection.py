"""Which effects, and how many: forward, with removal, by the blocks that were held out.

An effect enters if the blocks that were held out agree on it as surely as one effect by itself would have to
(`held_out_evidence`): while several are missing, each hides the others, and none would pass a stricter test. Of the
effects that explain the same, as far as the blocks can tell, the simplest is added, and the others are its aliases; so
is one that explains most of the same with far fewer parameters. Once one has entered, each of those before it has to
hold its place without it; at the end each has to pass as the best of all that were tried.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.robust_fit import Fit, HeldOut, RobustFit
from avtorch.gap.budget.score_test import Candidate, ScoreTest
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant

MOST_PARTS = 5
"""Effects that a selection may hold."""
_ROUNDS = 8  # of entering, as effects may leave again
_LEAST_NATS = 3.0  # in the blocks that fitted it, below which no effect is held out
_FAR_FEWER, _MOST_OF_IT = 3, 0.4  # parameters, and share of the gain, with which a simpler effect takes precedence
_OF_ITS_OWN = 0.5  # share of an effect's gain, on top of another, from which it is no alias of that
_FITTED = 9  # effects that are fitted, those of which a score test promises most
_SCREENING = 3  # iterations of these fits
_SCREENED = 5  # effects that are held out, of those fitted
_REFITTING = 5  # iterations after a model has lost an effect
_ONSET_NATS = 6.0  # that an onset must gain


@dataclass(frozen=True, eq=False)
class Step:
    """A model, the effect that `entered` last, its `strength` (`Evidence.strength`) and its `aliases` by name."""

    fit: Fit
    held: HeldOut
    entered: str | None = None
    strength: float = 0.0
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """`steps` from the bare baseline on; each has one effect more than the one before it."""

    fitting: RobustFit
    steps: tuple[Step, ...]

    @property
    def last(self) -> Step:
        return self.steps[-1]


def select(
    record: AnalysisRecord,
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    *,
    begun: Selection | None = None,
    most: int = MOST_PARTS,
    progress: Callable[[str, int, int], None] | None = None,
) -> Selection:
    """The effects of `kinds` that `base` lacks on these drives, at `most` so many, with every step on the way.

    `begun`: a selection of the same record, which is continued.
    """
    present = {e.name for e in base.effects}
    kinds = [k for k in kinds if not k.random and k.name not in present and _observable(k, record)]
    if begun is None:
        fitting, start = baseline_noise(record, base)
        begun = Selection(fitting, (Step(start, fitting.hold_out(start)),))
    fitting, bare, now = begun.fitting, begun.steps[0], begun.last
    entered = {s.entered: s for s in begun.steps if s.entered is not None}
    for number in range(_ROUNDS):
        step = None if len(now.fit.model.names) >= most else _enter(fitting, now, kinds, progress, number + 1)
        if step is None:
            break
        entered[step.fit.model.names[-1]] = step
        now, _ = _without_the_redundant(fitting, step, tried=1, spared=step.entered)
    now, strengths = _without_the_redundant(fitting, now, tried=len(kinds))
    aliases = {name: entered[name].aliases for name in now.fit.model.names}
    return Selection(fitting, (bare, *one_by_one(fitting, now, strengths, aliases)))


def one_by_one(
    fitting: RobustFit, last: Step, strengths: Mapping[str, float], aliases: Mapping[str, tuple[str, ...]]
) -> tuple[Step, ...]:
    """Steps up to `last` whose models grow by one effect each."""
    steps, names = [], last.fit.model.names
    for count, name in enumerate(names, start=1):
        fit = without_effects(fitting, last.fit, names[count:])
        held = last.held if fit is last.fit else fitting.hold_out(fit)
        steps.append(Step(fit, held, name, strengths.get(name, 0.0), aliases.get(name, (name,))))
    return tuple(steps)


def _observable(kind: type[Effect], record: AnalysisRecord) -> bool:
    if kind.needs_speed and not record.has_speed:
        return False
    return kind.place != "sensor" or len(record.channels) == 2


def baseline_noise(record: AnalysisRecord, base: GapPlant) -> tuple[RobustFit, Fit]:
    """The noise of these drives, and the bare baseline under it."""
    bare = EffectModel(record, base)
    starts = np.array(
        [
            bare.coordinates({"T_L": np.array(lag), LATENESS: np.array(late)})
            for lag in (-2.0, -1.0, 0.0, 1.0)
            for late in (-1.0, 0.0, 1.0)
        ]
    )
    whitening = NoiseWhitening.band(record, record.measured - record.measured[:, record.counts].mean(-1, keepdims=True))
    fit = RobustFit(whitening).fit(bare, starts)
    fit = RobustFit(NoiseWhitening.band(record, fit.residuals)).fit(bare, fit.z[None])
    fitting = RobustFit(NoiseWhitening.band(record, fit.residuals))
    for _ in range(3):
        fitting = RobustFit(NoiseWhitening.autoregressive(record, left_over(fitting, fit)))
        fit = fitting.fit(bare, np.concatenate([fit.z[None], starts]), iterations=12)
    return fitting, fit


def _enter(
    fitting: RobustFit,
    now: Step,
    kinds: Sequence[type[Effect]],
    progress: Callable[[str, int, int], None] | None,
    number: int,
) -> Step | None:
    test, names = ScoreTest.at(fitting, now.fit), now.fit.model.names
    candidates = []
    for kind in kinds:
        if kind.name in names:
            continue
        if progress is not None:
            progress(f"budget, effect {number}: {kind.name}", len(candidates), len(kinds) - len(names))
        candidates.append(test.candidate(kind))
    candidates.sort(key=lambda c: -c.promise)
    fits = [_fitted(fitting, test, c) for c in candidates[:_FITTED]]
    fits = [fit for fit in fits if now.fit.nats - fit.nats > _LEAST_NATS]
    fits.sort(key=lambda fit: fit.nats + _complexity(fit))
    tried = []
    for rough in fits[:_SCREENED]:
        fit = fitting.fit(rough.model, rough.z[None])
        name = fit.model.names[-1]
        if fit.model.at_limit(fit.z, name):
            continue
        held = fitting.hold_out(fit)
        tried.append(Step(fit, held, name, fitting.evidence(now.held, held).strength()))
    tried = [step for step in tried if step.strength > 0]
    if not tried:
        return None
    best = min(tried, key=_cost)
    same = [s for s in tried if s is best or _explains_the_same(fitting, now, best, s)]
    alike = [s for s in same if s is best or fitting.preference(s.held, best.held).strength() <= 0]
    chosen = min([s for s in same if s in alike or _much_simpler(now, best, s)], key=lambda s: _complexity(s.fit))
    aliases = {s.entered for s in alike} | {chosen.entered}
    return replace(chosen, aliases=tuple(sorted(name for name in aliases if name is not None)))


def _explains_the_same(fitting: RobustFit, now: Step, best: Step, other: Step) -> bool:
    """Whether little is left of what the other explains once the best is in."""
    return fitting.on_top(now.held, best.held, other.held) < _OF_ITS_OWN * (_cost(now) - _cost(other))


def _much_simpler(now: Step, best: Step, other: Step) -> bool:
    """Whether the other explains most of the same with far fewer parameters.

    A free course of the road follows a constant force too, and whatever else comes back at the same place; what a
    simpler effect leaves of that, the flexible one may explain afterwards.
    """
    fewer = _complexity(best.fit) - _complexity(other.fit)
    return fewer >= _FAR_FEWER and _cost(now) - _cost(other) > _MOST_OF_IT * (_cost(now) - _cost(best))


def _fitted(fitting: RobustFit, test: ScoreTest, candidate: Candidate) -> Fit:
    """The candidate fitted, from the start on or from the onset that promises most."""
    fit = fitting.fit(candidate.model, candidate.starts, iterations=_SCREENING)
    kind, logs = candidate.model.effects[-1], set(candidate.model.record.log)
    if kind.own_onset is not None or issubclass(kind, Integrated) or len(logs) > 1:
        return fit
    late = test.late(candidate)
    if late is None or late.promise < candidate.promise + _ONSET_NATS:
        return fit
    starts = np.concatenate([late.starts, late.model.coordinates(fit.known)[None]])
    later = fitting.fit(late.model, starts, iterations=_SCREENING)
    return later if later.nats + _ONSET_NATS < fit.nats else fit


def _cost(step: Step) -> float:
    """Nats of the blocks that were held out."""
    return float(step.held.nats.sum())


def _complexity(fit: Fit) -> int:
    """Parameters, those of a force along the road among them."""
    return fit.model.size + len(fit.model.onsets)


def _without_the_redundant(
    fitting: RobustFit, step: Step, *, tried: int, spared: str | None = None
) -> tuple[Step, dict[str, float]]:
    """The model without effects that do not hold their place, weakest first, and the strength of each that does."""
    while True:
        without: dict[str, Step] = {}
        for name in step.fit.model.names:
            if name != spared:
                fit = without_effects(fitting, step.fit, [name])
                held = fitting.hold_out(fit)
                without[name] = Step(fit, held, strength=fitting.evidence(held, step.held).strength(tried))
        if not without or min(s.strength for s in without.values()) > 0:
            return step, {name: s.strength for name, s in without.items()}
        step = min(without.values(), key=lambda s: s.strength)


def without_effects(fitting: RobustFit, fit: Fit, names: Collection[str]) -> Fit:
    """The model without some of its effects, fitted anew."""
    if not names:
        return fit
    model = fit.model
    for name in names:
        model = model.without(name)
    return fitting.fit(model, model.coordinates(fit.known)[None], iterations=_REFITTING)
