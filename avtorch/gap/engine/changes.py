"""Which changes explain how two sets of drives differ: a search among them, and the average of all visited sets.

From one car on, the promise of each change is computed to first order; the best are fitted and valued, and the best of
them stays while it gains. Evidence is tempered, against the prior odds of one more effect, as everywhere. But here the
temper is measured: two drives have blocks and halves, and what these disagree on, over what the likelihood says, is by
how much the likelihood is too sure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import EFFECTS
from avtorch.gap.engine.free_forms import band_products, gram
from avtorch.gap.engine.joint import (
    NO_CHANGE,
    SIZES,
    Change,
    JointFit,
    JointModel,
    Side,
    nats_of,
    noise_left,
    of_car,
    of_effect,
    of_growth,
)
from avtorch.gap.engine.likelihood import log_sum
from avtorch.gap.engine.priors import EFFECT_NATS, TEMPER, UNKNOWN_NATS
from avtorch.gap.engine.promises import limit_starts
from avtorch.gap.engine.search import tried
from avtorch.gap.engine.shape_error import effect_energy, relative_size, shape_log_odds

Progress = Callable[[str, int, int], None]
Key = tuple[str, Side]

MOST = 3
"""Changes at once, and as many effects of both sides."""
_FITTED = 6  # effects besides lag, gain and dead time
_STARTS = 2  # of an effect
_HELD = 0.9  # probability that an alias set holds


@dataclass(frozen=True, eq=False)
class Scatter:
    """How far a change's main coordinate is known: variances by the likelihood, by blocks, and of drift."""

    likelihood: float
    blocks: float
    drift: float

    @property
    def variance(self) -> float:
        return max(self.likelihood, self.blocks) + self.drift

    @property
    def drifts(self) -> bool:
        """Whether halves of one side disagree more than their blocks do."""
        return self.drift > max(self.likelihood, self.blocks)

    @property
    def temper(self) -> float:
        return self.likelihood / self.variance


@dataclass(frozen=True, eq=False)
class Visited:
    """A set of changes: its fit and `log_weight`, tempered, relative to one car."""

    fit: JointFit
    log_weight: float


@dataclass(frozen=True, eq=False)
class ChangePosterior:
    """`best`: the last set; `visited`: all, by their changes. `scatter` of each change in the best.

    `siblings`: names of what else may have entered where a change did. `rejected`: the strongest change of the last
    step, which did not enter, its scatter, and its log odds [nats] if it had none. `unknown`: probability that free
    forms differ besides.
    """

    model: JointModel
    best: Visited
    visited: Mapping[frozenset[Key], Visited]
    scatter: Mapping[Change, Scatter]
    siblings: Mapping[Key, tuple[str, ...]]
    rejected: tuple[JointFit, Scatter, float] | None
    unknown: float

    def probability(self, change: Change) -> float:
        """Of a change, over all visited sets."""
        return self._share(lambda key: change.key in key)

    def probability_of_any(self, names: Collection[str]) -> float:
        """That something differs which has one of these names."""
        return self._share(lambda key: any(name in names and side != "both" for name, side in key))

    def _share(self, holds: Callable[[frozenset[Key]], bool]) -> float:
        whole = log_sum([v.log_weight for v in self.visited.values()])
        own = [v.log_weight for key, v in self.visited.items() if holds(key)]
        return math.exp(log_sum(own) - whole) if own else 0.0


def candidates(model: JointModel, effects: Collection[str]) -> list[Change]:
    """T_L, K_L, the dead time, and of `effects` those that a car may gain or lose."""
    car = ["T_L", "K_L"] + ["dead_time"] * ("dead_time" in model.base.effects)
    out = [of_car(name) for name in car]
    held = {c.name for c in out} | set(model.own_effects)
    for e in tried(model.base, effects):
        if e.name in NO_CHANGE or e.onset == "must" or e.base in held:
            continue
        starts = e.starts or tuple(limit_starts(model.base))
        out += [of_effect(e, starts, "after"), of_effect(e, starts, "both")]
        if e.one_sided:
            out.append(of_effect(e, starts, "before"))
    return out


def search_changes(model: JointModel, changes: list[Change], progress: Progress | None = None) -> ChangePosterior:
    """The posterior over sets of `changes`."""
    now = Visited(model.start, 0.0)
    visited = {frozenset[Key](): now}
    passed = {_key(now.fit)}
    siblings: dict[Key, tuple[str, ...]] = {}
    rejected = None
    for number in range(1, 2 * MOST + 1):
        if sum(not c.shared for c in now.fit.changes) == MOST:
            break
        fits = []
        names = now.fit.names
        wanted = _promising(model, now.fit, [c for c in changes if c.name not in names])
        shared = [c for c in now.fit.changes if c.shared and names.count(c.name) == 1]
        wanted += [of_growth(c, now.fit.x[now.fit.at(c)]) for c in shared]
        for done, change in enumerate(wanted):
            if progress is not None:
                progress(f"change {number}: {change.name}", done, len(wanted))
            fits.append(model.with_change(now.fit, change))
        if not fits:
            break
        found = max(fits, key=lambda f: f.evidence)
        scatter = scatter_of(model, found, found.changes[-1])
        each = [Visited(f, _weight(now, f, scatter.temper)) for f in fits]
        for v in each:
            visited[_key(v.fit)] = v
        best = max(each, key=lambda v: v.log_weight)
        chosen = _alike(each)
        now = visited[_key(now.fit)] = _with_wrong_shape(model, now, best)
        if best.log_weight < now.log_weight:
            if not found.changes[-1].shared:
                rejected = found, scatter, found.evidence - now.fit.evidence - EFFECT_NATS
            break
        siblings[best.fit.changes[-1].key] = chosen
        now = best
        for change in now.fit.changes[:-1]:
            if now.fit.names.count(change.name) > 1:
                continue  # it is larger on one side
            rest = model.without(now.fit, change)
            lost = scatter.temper * (rest.evidence - now.fit.evidence)
            other = Visited(rest, now.log_weight + lost + TEMPER * EFFECT_NATS)
            if _key(rest) not in visited:
                visited[_key(rest)] = other
            if other.log_weight > now.log_weight:
                now = other
        if _key(now.fit) in passed:
            break  # tempers differ from step to step, so that a set may be left and entered again
        passed.add(_key(now.fit))
    scatters = {c: scatter_of(model, now.fit, c) for c in now.fit.changes}
    return ChangePosterior(model, now, visited, scatters, siblings, rejected, _unknown(model, now.fit))


def scatter_of(model: JointModel, fit: JointFit, change: Change) -> Scatter:
    """Of a change's largest coordinate in a fit."""
    likelihood, blocks, drift = model.covariance(fit)
    blocks = blocks * (model.blocks - 1) / max(model.blocks - 3, 1)  # of a variance from few blocks (Student)
    at = max(fit.at(change), key=lambda k: abs(fit.x[k]) / math.sqrt(likelihood[k, k]))
    return Scatter(float(likelihood[at, at]), float(blocks[at, at]), float(drift[at]))


def _key(fit: JointFit) -> frozenset[Key]:
    return frozenset(c.key for c in fit.changes)


def _weight(now: Visited, fit: JointFit, temper: float) -> float:
    return now.log_weight + temper * (fit.evidence - now.fit.evidence) - TEMPER * EFFECT_NATS


def _with_wrong_shape(model: JointModel, now: Visited, best: Visited) -> Visited:
    """A set with what another change gains beside it as far as that is an error in the shape of its own changes."""
    if not now.fit.changes:
        return now
    after = not best.fit.changes[-1].less
    data, noise = model.sides[after], best.fit.noise[after]
    first, with_all = now.fit.sides[after].predicted, best.fit.sides[after].predicted
    energy = effect_energy(data, first - model.start.sides[after].predicted)
    size = relative_size(data, noise, with_all - first, energy)
    worth = shape_log_odds(min(size, 99.0), best.fit.evidence - now.fit.evidence, ()) + EFFECT_NATS
    return Visited(now.fit, float(np.logaddexp(now.log_weight, best.log_weight + TEMPER * worth)))


def _alike(each: list[Visited]) -> tuple[str, ...]:
    """Names that hold nine tenths of the probability of what was tried, the most probable first."""
    each = [v for v in each if not v.fit.changes[-1].shared]
    whole, held = log_sum([v.log_weight for v in each]), 0.0
    names: list[str] = []
    for v in sorted(each, key=lambda v: -v.log_weight):
        names.append(v.fit.names[-1])
        held += math.exp(v.log_weight - whole)
        if held > _HELD:
            break
    return tuple(dict.fromkeys(names))


def _promising(model: JointModel, fit: JointFit, changes: list[Change]) -> list[Change]:
    """Those of the car, and the effects that promise most to first order, with their best starts."""
    own = [(c, s) for c in changes if c.effect for s in c.starts]
    crossed = np.zeros((len(fit.information), len(own)))
    gains, sizes = np.zeros(len(own)), np.zeros(len(own))
    for after in (False, True):
        at = [k for k, (change, _) in enumerate(own) if change.acts(after)]
        if not at:
            continue
        h, noise = fit.sides[after], fit.noise[after]
        signals = []
        for change, start in (own[k] for k in at):
            both = (*fit.changes, change)
            moved = model.hypothesis(both, model.coordinates(both), np.concatenate([fit.x, start]), after)
            signals.append(moved.response() - h.predicted)
        x = np.array(signals)
        base = np.concatenate([fit.derivatives[after], model.columns[after]])
        crossed[:, at] += gram(noise, band_products(h.data, base, x))
        gains[at] += gram(noise, band_products(h.data, model.left(fit, h)[None], x))[0]
        sizes[at] += [gram(noise, band_products(h.data, s[None], s[None]))[0, 0] for s in x]
    sizes = np.maximum(sizes - np.einsum("ij,ij->j", crossed, np.linalg.solve(fit.information, crossed)), 0.0)
    starts: dict[Change, list[tuple[float, ...]]] = {}
    for k in np.argsort(-0.5 * gains**2 / (sizes + 1)):
        change, start = own[k]
        if gains[k] <= 0 and EFFECTS[change.effect].one_sided:
            continue
        if len(start) == 1:
            start = (start[0] * float(np.clip(abs(gains[k]) / (sizes[k] + 1e-9), 0.2, 4.0)) * float(np.sign(gains[k])),)
        if change in starts or sum(c.shared == change.shared for c in starts) < _FITTED:
            starts.setdefault(change, []).append(start)
    best = [replace(c, starts=tuple(s[:_STARTS])) for c, s in starts.items()]
    return [c for c in changes if not c.effect] + best


def _unknown(model: JointModel, fit: JointFit) -> float:
    """Probability that the free forms differ between the sides, beyond what they do between halves of one side.

    Halves are a negative control: what has as much evidence within one side is no change.
    """
    halves = []
    for data in model.sides:
        second = np.zeros(data.frame_count)
        second[data.frame_count // 2 :] = 1.0
        halves.append(second)
    none = [np.zeros(len(x)) for x in halves]
    after = _own_forms(model, fit, [none[0], np.ones(len(halves[1]))])
    within = max(_own_forms(model, fit, [halves[0], none[1]]), _own_forms(model, fit, [none[0], halves[1]]), 0.0)
    odds = TEMPER * (after - within - UNKNOWN_NATS)
    return 1 / (1 + math.exp(-min(max(odds, -50.0), 50.0)))


def _own_forms(model: JointModel, fit: JointFit, acting: list[FloatArray]) -> float:
    """Gain [nats] of free forms with coefficients of their own in the frames `acting` (frame,) of each side."""
    count = len(fit.c)
    bases = [np.concatenate([j, c]) for j, c in zip(fit.derivatives, model.columns, strict=True)]
    own = [c * a[:, None] for c, a in zip(model.columns, acting, strict=True)]
    signals = [
        np.concatenate([model.left(fit, h)[None], base, x]) for h, base, x in zip(fit.sides, bases, own, strict=True)
    ]
    P = [band_products(h.data, x, x) for h, x in zip(fit.sides, signals, strict=True)]
    n = len(fit.information)
    precision = fit.information - sum(
        gram(noise, p[..., 1 : n + 1, 1 : n + 1]) for noise, p in zip(fit.noise, P, strict=True)
    )
    best = -math.inf
    for sd in SIZES:
        noise = list(fit.noise)
        prior = np.zeros((n + count, n + count))
        prior[:n, :n] = precision
        prior[n:, n:] = sd**-2 * np.eye(count)
        for _ in range(3):
            total = sum(gram(s, p) for s, p in zip(noise, P, strict=True))
            assert isinstance(total, np.ndarray)
            H = total[1:, 1:] + prior
            b = np.linalg.solve(H, total[1:, 0])
            left = np.append(1.0, -b)
            noise = [noise_left(p, left, h.data, k) for p, h, k in zip(P, fit.sides, model.known, strict=True)]
        whole, low = (
            sum(nats_of(h.data, s, k, fmax) for h, s, k in zip(fit.sides, noise, model.known, strict=True)) - before
            for fmax, before in ((math.inf, fit.log_likelihood), (None, fit.claimed))
        )
        occam = -count * math.log(sd) - 0.5 * float(np.linalg.slogdet(H)[1] - np.linalg.slogdet(fit.information)[1])
        best = max(best, min(low, whole) - 0.5 * float(b @ prior @ b) + occam)
    return best - math.log(len(SIZES))
