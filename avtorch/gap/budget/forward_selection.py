"""Which effects, and how many: forward, with removal, by the blocks that were held out.

An effect enters while the blocks that were held out gain from it by more than their scatter explains. Of the effects
that gain alike the simplest is taken, and the others are its aliases. Once one has entered, each of those before it has
to hold its place without it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.robust_fit import Fit, HeldOut, RobustFit
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant

_ERRORS = 2.5  # standard errors of the gain over held-out blocks that are enough
_NATS, _FEWER_ERRORS = 20.0, 1.2  # or so many nats, with so many standard errors
_LEAST_NATS = 4.0
_STAYS = -1.0  # strength down to which an effect holds its place
MOST_PARTS = 5
"""Effects that a selection may hold."""
_SCREENING = 2  # iterations of the fits that decide which effects are held out
_SCREENED = 6  # effects that are held out, of those fitted
_ONSET_NATS = 6.0  # that an onset must gain
_FAINT = -2.0  # prior SD, for effects that name no first values
_MOST_STARTS = 40


@dataclass(frozen=True, eq=False)
class Step:
    """A model and what held-out blocks gain by it: `gains` (block,) nats over the model before, `aliases` by name."""

    fit: Fit
    held: HeldOut
    entered: str | None = None
    gains: FloatArray | None = None
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """`steps` from the bare baseline on; each has one effect more than the one before it."""

    fitting: RobustFit
    steps: tuple[Step, ...]

    @property
    def last(self) -> Step:
        return self.steps[-1]


def strength(gains: FloatArray) -> float:
    """By how many standard errors held-out gains (block,) [nats] exceed what an effect needs to enter.

    Either nearly all blocks gain, or all together gain so much that noise would not: gains are skewed, because an
    effect of braking shows where the car brakes, and of a few large ones the scatter is large too.
    """
    total, blocks = float(gains.sum()), len(gains)
    error = max(float(gains.std(ddof=1)) * np.sqrt(blocks), 1e-12)
    errors = total / error
    many = min(errors - _FEWER_ERRORS, (total - _NATS) / error)
    return min(max(errors - _ERRORS, many), (total - _LEAST_NATS) / error)


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
    fitting, steps = begun.fitting, list(begun.steps)
    while len(steps) <= most:
        entered = _enter(fitting, steps[-1], kinds, progress, len(steps))
        if entered is None:
            break
        steps.append(entered)
        steps = _without_the_redundant(fitting, steps)
    return Selection(fitting, tuple(in_order(fitting, steps)))


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
    names = now.fit.model.names
    fits = []
    for kind in kinds:
        if kind.name in names:
            continue
        if progress is not None:
            progress(f"budget, effect {number}: {kind.name}", len(fits), len(kinds) - len(names))
        fits.append(_added(fitting, now.fit, kind, iterations=_SCREENING))
    fits.sort(key=lambda fit: fit.nats + _complexity(fit))
    tried = []
    for rough in fits[:_SCREENED]:
        fit = fitting.fit(rough.model, rough.z[None])
        name = fit.model.names[-1]
        if fit.model.at_limit(fit.z, name):
            continue
        held = fitting.hold_out(fit)
        tried.append(Step(fit, held, name, now.held.nats - held.nats))
    tried = [step for step in tried if step.gains is not None and strength(step.gains) > 0]
    if not tried:
        return None
    best = max(tried, key=_total)
    alike = [s for s in tried if s is best or _alike(best, s)]
    simplest = min(alike, key=lambda s: (_complexity(s.fit), -_total(s)))
    return replace(simplest, aliases=tuple(sorted(s.entered for s in alike if s.entered is not None)))


def _total(step: Step) -> float:
    return 0.0 if step.gains is None else float(step.gains.sum())


def _alike(best: Step, other: Step) -> bool:
    """Whether held-out blocks cannot tell the other from the best."""
    assert best.gains is not None
    assert other.gains is not None
    return strength(best.gains - other.gains) <= 0


def _complexity(fit: Fit) -> int:
    """Parameters, as many as the data can see: a force along the road has a coefficient for every knot."""
    return fit.model.size + len(fit.model.onsets) + 4 * sum(issubclass(e, Integrated) for e in fit.model.effects)


def _added(fitting: RobustFit, fit: Fit, kind: type[Effect], *, iterations: int) -> Fit:
    """The model with one effect more, from the start on or from an onset."""
    model = fit.model.with_effect(kind)
    starts = _starts(model, fit, kind)
    rough = fitting.fit(model, starts, iterations=iterations)
    if kind.own_onset is not None or issubclass(kind, Integrated) or len(set(fit.model.record.log)) > 1:
        return rough
    onset = _onset(fit, rough)
    if onset is None:
        return rough
    late_model, late_starts = model.setting_in(kind.name, onset), np.concatenate([rough.z[None], starts])
    late = fitting.fit(late_model, late_starts, iterations=iterations)
    return late if late.nats + _ONSET_NATS < rough.nats else rough


def _onset(before: Fit, after: Fit) -> float | None:
    """When the model `after` begins to be the better one [s], to a block; None where it is from the start."""
    record = after.model.record
    gains = before.block_nats - after.block_nats
    later = np.concatenate([np.cumsum(gains[::-1])[::-1], [0.0]])
    best = int(np.argmax(later))
    if best in (0, len(gains)) or later[best] < later[0] + _ONSET_NATS / 2:
        return None
    return float(record.time[record.block == best].min())


def _starts(model: EffectModel, fit: Fit, kind: type[Effect]) -> FloatArray:
    """First vectors (start, size): the parameters so far, with the effect's own first values."""
    time = model.record.time
    known, parameters = dict(fit.known), model.plant.parameters()
    grids, keys = [], []
    for name, values in kind.starts_in(float(time.min()), float(time.max())).items():
        key = f"{kind.name}.{name}"
        if key in model.index:
            keys.append(key)
            points = torch.tensor(values, dtype=torch.float64)
            grids.append([float(z) for z in parameters[key].unconstrain(points)])
    starts = [model.coordinates({**known, **dict(zip(keys, z, strict=True))}) for z in product(*grids)]
    own = [key for key in model.index if key.startswith(f"{kind.name}.")]
    if not grids and own and not issubclass(kind, Integrated):
        starts += [model.coordinates({**known, own[0]: np.array([z])}) for z in (_FAINT, -_FAINT)]
    out = np.clip(np.array(starts), model.low, model.high)
    if len(out) > _MOST_STARTS:
        out = out[np.linspace(0, len(out) - 1, _MOST_STARTS).astype(int)]
    # a lag and a delay trade places, so from a shorter lag too
    shorter = out.copy()
    shorter[:, model.index["T_L"]] -= 1.0
    return np.concatenate([out, shorter]) if kind.memory or kind.role == "delay" else out


def _without_the_redundant(fitting: RobustFit, steps: list[Step]) -> list[Step]:
    """Without effects that the last one has made superfluous."""
    last = steps[-1]
    for name in last.fit.model.names[:-1]:
        fit = without_effect(fitting, last.fit, name)
        held = fitting.hold_out(fit)
        if strength(held.nats - last.held.nats) > _STAYS:
            continue
        kept = [s for s in steps[:-1] if name not in s.fit.model.names]
        return [*kept, replace(last, fit=fit, held=held)]
    return steps


def without_effect(fitting: RobustFit, fit: Fit, name: str) -> Fit:
    """The model without one of its effects, fitted anew."""
    model = fit.model.without(name)
    return fitting.fit(model, model.coordinates(fit.known)[None])


def in_order(fitting: RobustFit, steps: list[Step]) -> list[Step]:
    """Steps whose models grow by one effect each, as removal may have left gaps between them."""
    aliases = {s.entered: s.aliases for s in steps if s.entered is not None}
    last, out = steps[-1], [steps[0]]
    for count in range(1, len(last.fit.model.names) + 1):
        names = last.fit.model.names[:count]
        step = next((s for s in steps if s.fit.model.names == names and s.entered == names[-1]), None)
        if step is None or count == len(last.fit.model.names):
            fit = last.fit
            for name in last.fit.model.names[count:]:
                fit = without_effect(fitting, fit, name)
            held = last.held if fit is last.fit else fitting.hold_out(fit)
            step = Step(fit, held, names[-1])
        gains = out[-1].held.nats - step.held.nats
        out.append(replace(step, entered=names[-1], gains=gains, aliases=aliases.get(names[-1], (names[-1],))))
    return out
