"""Which changes explain the difference between two sets of drives: forward, with removal, by blocks held out.

The null hypothesis is one car: the same lag, gain and dead time on both sides, and the same remainder. A change enters
while held-out blocks gain from it by more than their scatter explains (`strength`), and while it is larger than what
halves of one side differ by.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.budget.joint_whitening import of_both_channels
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.change.change_model import Change, ChangeModel
from avtorch.gap.change.joint_fit import Fit, HeldOut, JointFit
from avtorch.gap.change.shared_remainder import BASIC, columns
from avtorch.gap.change.two_sides import TwoSides
from avtorch.gap.simulator.plant import GapPlant

Progress = Callable[[str, int, int], None]

MOST = 3
"""Changes at once."""
_ROUNDS = 2 * MOST  # that one change enters in; one that has left may enter again
DRIFT_ERRORS = 2.0
"""Standard errors, halves of one side among them, by which a change must differ from none."""
_ERRORS = 2.5  # standard errors of the gain over held-out blocks that are enough
_NATS, _FEWER_ERRORS = 20.0, 1.2  # or so many nats, with so many standard errors
_LEAST_NATS = 4.0
_SCREENING = 2  # iterations of the fits that decide which changes are held out
_SCREENED = 6  # besides lag, gain and dead time
_STAYS = -1.0  # strength down to which a change holds its place
_RIDGES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)
_NOISE_RIDGE = 1e-4  # of the regression whose left-over is the noise


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


@dataclass(frozen=True, eq=False)
class Step:
    """A model with one change more, and what held-out blocks gain by it: `gains` (block,) nats.

    `relative_sd`: standard error of the change as a share of itself, from blocks; `drift`: how much of it comes and
    goes between the halves of one side.
    """

    fit: Fit
    held: HeldOut
    change: Change | None = None
    gains: FloatArray | None = None
    relative_sd: float = 0.0
    drift: float = 0.0
    aliases: tuple[str, ...] = ()

    @property
    def surplus(self) -> float:
        """Standard errors by which the change is more than drift, beyond what is needed."""
        return 1.0 / max(float(np.hypot(self.relative_sd, self.drift)), 1e-9) - DRIFT_ERRORS


@dataclass(frozen=True, eq=False)
class ChangeSelection:
    """`steps` from one car on, each with one change more; `tried`: changes that were held out at the first step.

    `rejected`: the strongest change that held-out blocks support and that did not enter, because halves of one side
    differ by as much or because blocks disagree on its size; `other`: strength of a remainder of the drives after
    alone, on top of the last step.
    """

    sides: TwoSides
    fitting: JointFit
    steps: tuple[Step, ...]
    tried: tuple[Step, ...]
    rejected: Step | None
    other: float

    @property
    def last(self) -> Step:
        return self.steps[-1]


def strength_of(gains: FloatArray, sides: TwoSides) -> float:
    """`strength` of gains (block,), with their scatter within each side: that the sides differ is what is sought."""
    level = gains.copy()
    after = sides.block_is_after
    for side in (after, ~after):
        level[side] += gains.mean() - gains[side].mean()
    return strength(level)


def select_changes(
    sides: TwoSides, base: GapPlant, candidates: Sequence[Change], *, progress: Progress | None = None
) -> ChangeSelection:
    """The changes of `candidates` that the drives support, with every step on the way."""
    fitting, start = _noise(sides, base, progress)
    steps = [Step(start, fitting.hold_out(start))]
    first: tuple[Step, ...] = ()
    rejected = None
    for number in range(1, _ROUNDS + 1):
        if len(steps) > MOST:
            break
        tried = _tried(sides, fitting, steps[-1], candidates, progress, number)
        first = first or tuple(tried)
        supported = [_with_drift(sides, fitting, s) for s in tried if _strength(s, sides) > 0]
        entering = [s for s in supported if s.surplus > 0]
        if not entering:
            rejected = max(supported, key=_total, default=None)
            break
        steps.append(_simplest(sides, entering))
        steps = _without_the_redundant(sides, fitting, steps)
    return ChangeSelection(sides, fitting, tuple(steps), first, rejected, _other(sides, fitting, steps[-1]))


def _strength(step: Step, sides: TwoSides) -> float:
    assert step.gains is not None
    return strength_of(step.gains, sides)


def _total(step: Step) -> float:
    return 0.0 if step.gains is None else float(step.gains.sum())


def _noise(sides: TwoSides, base: GapPlant, progress: Progress | None) -> tuple[JointFit, Fit]:
    """The noise of both sides, what they share, and how stiff the remainder is.

    Noise is what a remainder with coefficients of its own on either side leaves, so that no change is taken for it.
    """
    record, model = sides.whole, ChangeModel(sides, base)
    mean = record.measured - record.measured[:, record.counts].mean(-1, keepdims=True)
    whitening = NoiseWhitening.band(record, mean)
    starts, basic = model.starts({}), BASIC if len(record.channels) == 2 else BASIC - 1
    fit = JointFit(whitening, columns(record, model.simulate(starts[0])[0])[:basic]).fit(model, starts)
    for number in range(2):
        if progress is not None:
            progress("noise of both drives", number, 2)
        shapes = columns(record, model.simulate(fit.p)[0])
        both = JointFit(whitening, np.concatenate([shapes, shapes * sides.is_after]), ridge=_NOISE_RIDGE)
        whitening = of_both_channels(record, both.left(both.fit(model, fit.p[None], iterations=3)))
        fit = JointFit(whitening, shapes[:basic]).fit(model, np.concatenate([fit.p[None], starts]), iterations=10)
    shapes = columns(record, model.simulate(fit.p)[0])
    fitting = replace(JointFit(whitening, shapes).beyond(model, fit.p, basic), anchor=model.named(fit.p))
    costs = []
    for ridge in _RIDGES:
        stiff = replace(fitting, ridge=ridge)
        fit = stiff.fit(model, np.array([fit.p]), iterations=3)
        costs.append((float(stiff.hold_out(fit).nats.sum()), ridge, fit))
    _, ridge, fit = min(costs, key=lambda x: x[0])
    return replace(fitting, ridge=ridge), fit


def _tried(
    sides: TwoSides,
    fitting: JointFit,
    now: Step,
    candidates: Sequence[Change],
    progress: Progress | None,
    number: int,
) -> list[Step]:
    """What may enter: lag, gain, dead time, and the effects that fit best, each held out."""
    names = now.fit.model.names
    rest = [c for c in candidates if c.name not in names]
    rough = []
    for done, change in enumerate(rest):
        if progress is not None:
            progress(f"change {number}: {change.name}", done, len(rest))
        model = now.fit.model.with_change(change)
        rough.append(fitting.fit(model, model.starts(now.fit.model.named(now.fit.p)), iterations=_SCREENING))
    rough.sort(key=lambda fit: fit.nats + fit.model.size)
    own = [fit for fit in rough if fit.model.changes[-1].parameter is not None]
    effects = [fit for fit in rough if fit.model.changes[-1].parameter is None][:_SCREENED]
    out = []
    for fit in [*own, *effects]:
        fit = fitting.fit(fit.model, fit.p[None])
        change = fit.model.changes[-1]
        if not fit.model.at_limit(fit.p, change):
            held = fitting.hold_out(fit)
            out.append(Step(fit, held, change, now.held.nats - held.nats))
    return out


def _with_drift(sides: TwoSides, fitting: JointFit, step: Step) -> Step:
    """With the change's error from blocks, and its drift from the halves of both sides.

    The same difference is regressed on the second half of the drives before against the first, and of those after. What
    its square exceeds the error by is drift; the halves count by what they know.
    """
    model, p = step.fit.model, step.fit.p
    changed = _last_difference(model, p)
    halves = [sides.second_half(after) for after in (False, True)]
    added = np.array([changed * sides.is_after, *(changed * half for half in halves)])
    others = model.without(model.changes[-1]).size  # the change's own coordinates would do the same
    values, errors = fitting.sizes(step.fit, added, others)
    alone = fitting.sizes(step.fit, added[:1], others)[1][0]
    known = np.isfinite(errors[1:])
    drift = 0.0
    if known.any():
        square, variance = values[1:][known] ** 2, np.maximum(errors[1:][known], 1e-9) ** 2
        drift = float(np.sqrt((np.maximum(square - variance, 0.0) / variance).sum() / (1 / variance).sum()))
    return replace(step, relative_sd=float(alone), drift=drift)


def _last_difference(model: ChangeModel, p: FloatArray) -> FloatArray:
    """(channel, row): what the last change alone makes of the drives of both sides."""
    whole = model.difference(p)
    if len(model.changes) == 1:
        return whole
    smaller = model.without(model.changes[-1])
    return whole - smaller.difference(smaller.coordinates(model.named(p)))


def _simplest(sides: TwoSides, entering: Sequence[Step]) -> Step:
    """Of the changes that held-out blocks cannot distinguish from the best, the one with the fewest parameters."""
    best = max(entering, key=_total)
    assert best.gains is not None
    alike = [
        s for s in entering if s is best or (s.gains is not None and strength_of(best.gains - s.gains, sides) <= 0)
    ]
    simplest = min(alike, key=lambda s: (s.fit.model.size, -_total(s)))
    names = dict.fromkeys(s.change.name for s in sorted(alike, key=_total, reverse=True) if s.change is not None)
    return replace(simplest, aliases=tuple(names))


def _without_the_redundant(sides: TwoSides, fitting: JointFit, steps: list[Step]) -> list[Step]:
    """Without a change that the later ones have made superfluous; those between are fitted again without it."""
    last = steps[-1]
    for at, change in enumerate(last.fit.model.changes[:-1], start=1):
        fit = _without(fitting, last, change)
        if strength_of(fitting.hold_out(fit).nats - last.held.nats, sides) > _STAYS:
            continue
        kept = steps[:at]
        for step in steps[at + 1 : -1]:
            kept.append(_again(sides, fitting, kept[-1], step, _without(fitting, step, change)))
        return [*kept, _again(sides, fitting, kept[-1], last, fit)]
    return steps


def _without(fitting: JointFit, step: Step, change: Change) -> Fit:
    model = step.fit.model.without(change)
    return fitting.fit(model, model.coordinates(step.fit.model.named(step.fit.p))[None])


def _again(sides: TwoSides, fitting: JointFit, before: Step, step: Step, fit: Fit) -> Step:
    """A step with another fit, on top of another one `before` it."""
    held = fitting.hold_out(fit)
    return _with_drift(sides, fitting, replace(step, fit=fit, held=held, gains=before.held.nats - held.nats))


def _other(sides: TwoSides, fitting: JointFit, now: Step) -> float:
    """Strength of a remainder that only the drives after have: something else has changed, whatever it is."""
    shapes = columns(sides.whole, now.fit.model.simulate(now.fit.p)[0])
    both = replace(fitting, shapes=np.concatenate([shapes, shapes * sides.is_after]))
    begun = replace(now.fit, c=np.concatenate([now.fit.c, np.zeros(len(shapes))]))
    best = -np.inf
    for ridge in (1e-2, 1e-1, 1.0):
        stiff = replace(both, ridge=ridge)
        fit = stiff.fit(begun.model, begun.p[None], iterations=2)
        best = max(best, strength_of(now.held.nats - stiff.hold_out(fit).nats, sides))
    return best
