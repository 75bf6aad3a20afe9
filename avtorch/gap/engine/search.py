"""A search over sets of effects, which keeps every set that it visits.

From a set, the promise of each further effect is computed to first order: the projection of the residual on the
effect's response, in units of the noise, after the parameters that are in have taken what they can. The most promising
effects are fitted, the best of them finished (delay against lag, limits, onsets), and each effect is then left out in
turn. The answer is not the last set but the average of all visited ones (`average`).

Three bases compete in the same evidence: K u, K u with a resistance R(v), and any force map F(u, v). The price of a map
is linear, one Gram matrix for all sizes. A base is its fit: lag, gain, recorder and map together, the prior size of the
map chosen anew from round to round, and all sizes summed in the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, EngineEffect, base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.force_base import prices, resized, with_force_map
from avtorch.gap.engine.gauss_newton import fit, linearised, normal_prior, objective, whitened_jacobian
from avtorch.gap.engine.gear_shifts import refined_shift_speeds, shift_speeds, upshift_rows
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import log_likelihood, whiten
from avtorch.gap.engine.lost_messages import with_lost_messages
from avtorch.gap.engine.priors import WITHIN_NATS
from avtorch.gap.engine.recorder import traded

_MOST_FITS, _FEWEST_FITS = 160, 40  # of a search; a hard case of five minutes takes about fifty
_GRID_FITS = 4e6  # fits times grid points: what a long drive may cost
_WIDTH, _LATER_WIDTH, _SECOND_WIDTH = 9, 6, 4  # effects fitted from the base, from a set, on a second way in
_FINISHED = 3  # of these, how many are finished
_RAMPS = 10  # of a gain that changes, from a second to the drive's length
_MARGIN_S = 8.0  # no onset this near to an end of the drive
_LEAST_PROMISE = 1.5  # nats: less is the gain of a parameter that does nothing
_SLOPES = {
    "dead_time": 0.02,
    "sensor_lag": 0.02,
    "speed_lag": 0.02,
    "square_period": 0.002,
}  # where a recorder hides a finite step
_SLOW_MPS = 3.0
_SHARP = ("sensor_bias", "constant_resistance", "sensor_scale")  # effects that set in at once


class Promise(NamedTuple):
    """What an effect may gain to first order [nats], from which start, and from which time on."""

    nats: float
    effect: str
    start: tuple[float, ...]
    onset: float | None


@dataclass(eq=False)
class Search:
    """A search from a fitted `base`, among `effects`; at most `most` in a set. With one channel the car's own unnamed
    dynamics belong to the base.

    `most_fits` bounds what it may cost, by the length of the drive, `stop()` ends it where it returns True; `complete`
    tells whether one of them did. `visited` maps a set (names, and whether each has an onset; the name of
    its force map) to its best hypothesis. `map_bases`: bases with a force map that sets have grown from.
    """

    base: Hypothesis
    effects: Collection[str] = tuple(EFFECTS)
    most: int = 4
    stop: Callable[[], bool] | None = None
    progress: Callable[[str, int, int], None] | None = None
    visited: dict[tuple[tuple[str, bool], ...], Hypothesis] = field(default_factory=dict)
    fits: int = 0
    most_fits: int = field(init=False)
    complete: bool = True
    map_bases: list[Hypothesis] = field(default_factory=list)
    _shifts_refined: bool = False

    def __post_init__(self) -> None:
        self.most_fits = int(np.clip(_GRID_FITS / len(self.base.data.grid.time), _FEWEST_FITS, _MOST_FITS))

    def run(self) -> Hypothesis:
        """The best set found."""
        best = self._put(self.base)
        if best.alone and "~linear" in self.effects:
            ways = [self._put(fit(self._add(best, "~linear", s, None, 10), 6)) for s in EFFECTS["~linear"].starts[1:]]
            free = max(ways, key=lambda h: h.score)
            if free.score > best.score:  # the car's own dynamics, without a name
                self.visited.clear()
                self.base, free.base = free, free
                best = self._put(free)
        best = self.extended(best)
        if "gear_shift" in self.effects and "gear_shift" not in best.effects and not self._ended():
            # interruptions may show once other effects are in
            speeds, nats = shift_speeds(best)
            if len(speeds) and nats > 5 and not np.array_equal(speeds, best.shift_speeds):
                best = best.copy()
                best.shift_speeds = speeds
                best = self.extended(self._put(best.evaluate(), anew=True), another_way=False)
        return self._in_front_of_a_map(best)

    def _in_front_of_a_map(self, best: Hypothesis) -> Hypothesis:
        """The best set where the car's force may be any map: sets grow from each base with a map that could win.

        A map competes with the names that were found without it: it has to gain something, beside these or by itself,
        and not be far behind them. Where it does not, nothing changes. With one channel nothing tells a map from the
        base's own unnamed dynamics: there names stand alone.
        """
        if self.base.data.channel_count == 1 or (self.stop is not None and self.stop()):
            return best
        more = best.score - self.base.score
        alone, beside = prices(self.base), prices(best) if more > 0 else []
        wanted = {p.form.name: p.nats for p in beside if p.gains}
        wanted |= {p.form.name: p.nats - more for p in alone if p.gains and p.form.name not in wanted}
        least = max([0.0, *wanted.values()]) - WITHIN_NATS
        bases = [with_force_map(self.base, p.form) for p in alone if wanted.get(p.form.name, -np.inf) > least]
        best_base = max((h.score for h in bases), default=0.0)
        self.map_bases = [h for h in bases if h.score > best_base - WITHIN_NATS]
        for base in self.map_bases:
            self._put(base)
            self.fits = self.most_fits // 2  # sets in front of a map begin where those without one ended
            found = self._with_map_of(best, base)
            best = max(best, self.extended(found, another_way=False), key=lambda h: h.score)
        return best

    def _with_map_of(self, h: Hypothesis, base: Hypothesis) -> Hypothesis:
        """The best set in front of a base's map that has none but the effects of `h`: a map takes some of them up."""
        now = h.copy()
        now.base, now.plain, now.force, now.force_coefficients = base, base.plain, base.force, base.force_coefficients
        for e in h.effects:
            if base.force is not None and base_name(e) in base.force.takes_up:
                now = now.without(e)
        if h.force is not None or set(now.effects) <= set(base.effects):
            return base
        return max(base, self._pruned(self._put(fit(now, 10)), last=True), key=lambda h: h.score)

    def extended(self, start: Hypothesis, another_way: bool = True) -> Hypothesis:
        """The best set that grows from `start`, by one more effect at a time."""
        best, first = self._climbed(start, _WIDTH, _LATER_WIDTH, _FINISHED)
        if another_way and self._size(best) - self._size(start) >= 2:
            for h in first[1:]:  # a second way in, where the first needed several effects
                if self._ended() or h.score < start.score + 3 or set(h.effects) <= set(best.effects):
                    continue
                best = max(best, self._climbed(h, _SECOND_WIDTH, _SECOND_WIDTH, 1)[0], key=lambda h: h.score)
        return best

    def _climbed(
        self, start: Hypothesis, width: int, later_width: int, finished: int
    ) -> tuple[Hypothesis, list[Hypothesis]]:
        """The best set that grows from `start`, and the sets that were finished in the first step, the best first."""
        best, first = start, list[Hypothesis]()
        while self._size(best) < self.most and not self._ended():
            grown = self._grow(best, width if best is start else later_width)
            if not grown:
                break
            grown = sorted((self._put(self._finish(h)) for h in grown[:finished]), key=lambda h: -h.score)
            first = grown if best is start else first
            if grown[0].score < best.score:
                break
            best = self._pruned(grown[0])
        return best, first

    def key(self, h: Hypothesis, without: str | None = None) -> tuple[tuple[str, bool], ...]:
        own = [(base_name(e), e in h.onsets) for e in h.effects if e != without]
        return tuple(sorted(own if h.force is None else [*own, (h.force.name, False)]))

    def without(self, h: Hypothesis, effect: str) -> Hypothesis | None:
        """The visited hypothesis with the other effects, if there is one."""
        return self.visited.get(self.key(h, without=effect))

    # steps -------------------------------------------------------------------------------------------------------
    def _ended(self) -> bool:
        if self.fits >= self.most_fits or (self.stop is not None and self.stop()):
            self.complete = self.complete and self.stop is None
            return True
        return False

    @staticmethod
    def _size(h: Hypothesis) -> int:
        return sum(e != "~linear" for e in h.effects)

    def _put(self, h: Hypothesis, anew: bool = False) -> Hypothesis:
        evaluate_evidence(h if h.base is h else resized(h)).jacobian = None
        key = self.key(h)
        if anew or key not in self.visited or self.visited[key].score < h.score:
            self.visited[key] = h
        return h

    def _grow(self, h: Hypothesis, width: int) -> list[Hypothesis]:
        """The most promising sets with one more effect, fitted, the best first."""
        best: dict[str, Hypothesis] = {}
        fitted: set[str] = set()

        def better(effect: str, found: Hypothesis) -> None:
            if effect not in best or best[effect].score < found.score:
                best[effect] = found

        for promise in promises(h, tried(h, self.effects)):
            if promise.nats < _LEAST_PROMISE or self._ended():
                break
            if promise.effect not in fitted and len(fitted) >= width:
                continue
            fitted.add(promise.effect)
            found = self._add(h, promise.effect, promise.start, promise.onset, 6)
            if promise.onset is not None and promise.effect in _SHARP:
                found = refined_onset(found, promise.effect)
            better(promise.effect, self._put(found))
            if self.progress is not None:
                self.progress("effects", min(self.fits, self.most_fits), self.most_fits)
        if h.alone and "dead_time" in self.effects and "dead_time" not in h.effects and not self._ended():
            # other dynamics hide a delay from its promise
            better("dead_time", self._put(self._add(h, "dead_time", (0.15,), None, 10)))
        if "command_hold" in self.effects and "command_hold" not in h.effects and not self._ended():
            mask = upshift_rows(h.data, h.shift_speeds) if "gear_shift" in h.effects else None
            found = with_lost_messages(h, mask)
            if found is not None:
                better("command_hold", self._put(found))
        return sorted(best.values(), key=lambda x: -x.score)

    def _add(
        self, h: Hypothesis, effect: str, start: Sequence[float], onset: float | None, iterations: int = 7
    ) -> Hypothesis:
        """The fitted hypothesis with one more effect."""
        self.fits += 1
        new = h.with_effect(effect, start, onset)
        if effect == "dead_time" and onset is None:  # what is a delay now was a lag before
            shorter = new.copy()
            shorter["T_L"] = max(new["T_L"] - 0.8 * start[0], min(new["T_L"], 0.06))
            if shorter.evaluate().log_likelihood > new.evaluate().log_likelihood:
                new = shorter
        other = new.copy()
        out = fit(new, iterations, 0.1)
        if out["T_L"] < 0.05:  # a lag at its end: the other mode
            other["T_L"] = 0.4
            out = max(out, fit(other, iterations, 0.1), key=lambda x: x.log_likelihood)
        return out

    def _finish(self, h: Hypothesis) -> Hypothesis:
        h = other_limit(traded(h))
        if "gear_shift" in h.effects and not self._shifts_refined:
            h = refined_shift_speeds(h)
            self._shifts_refined = True
        if "gain_change" in h.effects:
            h = other_ramp(h)
        for e in list(h.onsets):
            h = refined_onset(h, e)
        return h

    def _pruned(self, h: Hypothesis, last: bool = False) -> Hypothesis:
        """The best after leaving out each effect but the last (that too where `last`) in turn, and each onset."""
        while h.effects and not self._ended():
            others = []
            for e in h.effects if last else h.effects[:-1]:
                if e == "~linear":
                    continue
                self.fits += 1
                others.append(self._put(fit(h.without(e), 6)))
            others += self._without_onsets(h)
            if not others:
                break
            best = max(others, key=lambda x: x.score)
            if best.score <= h.score:
                break
            h = best
        return h

    def _without_onsets(self, h: Hypothesis) -> Iterator[Hypothesis]:
        """The set without one of its onsets, the first part of an effect that may go."""
        for e in list(h.onsets):
            if EFFECTS[e].onset == "must":
                continue
            rest = h.without(e)
            wanted = tuple(sorted([*self.key(rest), (base_name(e), False)]))
            if wanted in self.visited:
                continue
            starts = [tuple(h[c.name] for c in EFFECTS[e].coordinates)]
            starts += list(EFFECTS[e].starts) if e == "dead_time" else []
            yield max((self._put(self._add(rest, e, s, None)) for s in starts), key=lambda x: x.score)


def tried(h: Hypothesis, among: Collection[str]) -> list[EngineEffect]:
    """The effects that may be added to `h`, those `among` which its drives can show."""
    data, own = h.data, {base_name(e) for e in h.effects}
    out = []
    for e in EFFECTS.values():
        if e.name not in among and e.base not in among:
            continue
        if e.base in own or e.name == "command_hold" or not e.needs <= set(data.channels):
            continue
        if h.force is not None and e.base in h.force.takes_up:
            continue
        if e.name == "~linear" and not h.alone:
            continue
        if e.name == "low_speed_creep" and (data.smooth_speed < _SLOW_MPS).mean() < 0.01:
            continue
        if e.name == "gear_shift" and not len(h.shift_speeds):
            continue
        out.append(e)
    return out


# promises ------------------------------------------------------------------------------------------------------------
class Projection:
    """The residual and any response less what the free parameters take, in units of the noise.

    Priors are rows of their own: a recorder stretched to its limits to hide an effect pulls back.
    """

    def __init__(self, h: Hypothesis) -> None:
        names = h.free
        slopes, precision, pull = linearised(h, names)
        W = whitened_jacobian(h, slopes)
        self.rows = len(W)
        A = np.hstack([W, np.diag(np.sqrt(precision))])
        r = np.concatenate([whiten(h.data, h.covariance, h.residual), pull / np.sqrt(np.maximum(precision, 1e-30))])
        size = np.linalg.norm(A, axis=1)
        self._basis = np.linalg.qr((A[size > 1e-9] / size[size > 1e-9, None]).T)[0]
        self._basis_by_frame = _by_frame(h.data, self._basis[: -self.rows])
        self.residual = r - self._basis @ (self._basis.T @ r)

        self._data, self._spread = h.data, None
        if h.force_spread is not None:
            inverse = np.linalg.inv(np.linalg.cholesky(h.covariance))
            self._spread = inverse @ h.force_spread @ np.swapaxes(inverse, 1, 2)
        self._start = self._nats(self.residual)

    def __call__(self, whitened: FloatArray) -> FloatArray:
        x = np.concatenate([whitened, np.zeros(self.rows)])
        return x - self._basis @ (self._basis.T @ x)

    def sizes_from(self, whitened: FloatArray) -> FloatArray:
        """Square (frame,) of the projected response that begins with each frame: whole, less its part in the span."""
        x = _by_frame(self._data, whitened)
        spanned = (x[:, None] @ self._basis_by_frame)[:, 0]
        energy, spanned = (x * x).sum(1)[::-1].cumsum(), spanned[::-1].cumsum(0)
        return np.maximum(energy - (spanned**2).sum(1), 0.0)[::-1]

    def nats(self, free: FloatArray, e: EngineEffect, start: Sequence[float]) -> float:
        """What the best multiple of a projected response gains, its size penalised by the effect's prior; the noise's
        covariance is that of what is left, as everywhere: a band's own excess does not hide what explains it."""
        gain, size = float(free @ self.residual), float(free @ free)
        sds = [normal_prior(c.name, 0.0)[1] for c in e.coordinates if c.faint]
        precision = sum((x / sd) ** 2 for x, sd in zip(start, sds, strict=False))
        shares = gain / (size + 1), gain / max(size, 1e-9)
        return max(self._nats(self.residual - x * free) - 0.5 * precision * x * x for x in shares) - self._start

    def _nats(self, x: FloatArray) -> float:
        data = self._data
        shape = data.channel_count, data.frame_count, data.bin_count
        nats = log_likelihood(data, x[: -self.rows].reshape(shape), self._spread)[0]
        return nats - 0.5 * float(x[-self.rows :] @ x[-self.rows :])


def _by_frame(data: DriveData, whitened: FloatArray) -> FloatArray:
    """Coefficients of all channels (channel x frame x bin, ...) by frame: (frame, channel x bin, ...)."""
    by_frame = whitened.reshape(data.channel_count, data.frame_count, data.bin_count, *whitened.shape[1:])
    by_frame = np.moveaxis(by_frame, 1, 0)
    return np.ascontiguousarray(by_frame.reshape(data.frame_count, -1, *whitened.shape[1:]))


def promises(h: Hypothesis, candidates: Sequence[EngineEffect]) -> list[Promise]:
    """Gains of further effects to first order, the best first: at most two a effect that act all the time, and one
    that sets in later."""
    projection = Projection(h)
    adjoint = _adjoint_rows(h, projection)
    response = h.rows()
    out: list[Promise] = []
    for e in candidates:
        always: list[Promise] = []
        later: list[Promise] = []
        for start in e.starts or limit_starts(h):
            for kept in (False, True) if e.name == "dead_time" else (False,):
                p = h.values.copy()
                for c, x in zip(e.coordinates, start, strict=True):
                    p[INDEX[c.name]] = x
                if kept:  # a lag hides most of a delay
                    p[0] = max(p[0] - 0.8 * start[0], min(p[0], 0.06))
                # the simulator runs an effect only where a hypothesis has it
                beside = h if e.kind is None and h.baseline is None else h.with_effect(e.name, start)
                rows = beside.rows(p)
                change = h.data.transform(rows) - h.predicted
                whitened = whiten(h.data, h.covariance, change)
                if not kept:
                    always += _by_slope(beside, projection, e, start)
                if e.onset != "must":
                    always += _whole(h, projection, e, start, whitened)
                if e.onset != "never":
                    steps = sum(z * (a - b) for z, a, b in zip(adjoint, rows, response, strict=True))
                    assert isinstance(steps, np.ndarray)
                    later += _onsets(beside, projection, e, start, p, whitened, steps)
        always.sort(key=lambda x: -x.nats)
        later.sort(key=lambda x: -x.nats)
        if always and later and later[0].nats < always[0].nats - 1:
            later = []
        out += always[:2] + later[:1]
    return sorted(out, key=lambda x: -x.nats)


def _whole(
    h: Hypothesis, projection: Projection, e: EngineEffect, start: tuple[float, ...], whitened: FloatArray
) -> list[Promise]:
    free = projection(whitened)
    size, gain = float(free @ free), float(free @ projection.residual)
    if size <= 1e-6 * float(whitened @ whitened) or (gain <= 0 and e.one_sided):
        return []
    turned = start if gain > 0 or e.name == "driveline_oscillation" else tuple(-x for x in start)
    return [Promise(projection.nats(free, e, start), e.name, turned, None)]


def _by_slope(h: Hypothesis, projection: Projection, e: EngineEffect, start: tuple[float, ...]) -> list[Promise]:
    """By the slope at zero, where the recorder hides a finite step."""
    name = e.coordinates[0].name
    if name not in _SLOPES or e.onset == "must":
        return []
    p = h.values.copy()
    p[INDEX[name]] = _SLOPES[name]
    change = (h.response(p) - h.predicted) * (start[0] / _SLOPES[name])
    free = projection(whiten(h.data, h.covariance, change))
    gain = float(free @ projection.residual)
    return [Promise(projection.nats(free, e, start), e.name, start, None)] if gain > 0 else []


def _onsets(
    h: Hypothesis,
    projection: Projection,
    e: EngineEffect,
    start: tuple[float, ...],
    values: FloatArray,
    whitened: FloatArray,
    steps: FloatArray,
) -> list[Promise]:
    """The two best onsets, and those of effects that are in: the residual's adjoint prices all rows at once, then the
    response is computed."""
    data = h.data
    if data.frame_count < 2:
        return []
    gains = np.cumsum(steps[::-1])[::-1]
    sizes = projection.sizes_from(whitened)
    size = np.interp(data.time, data.frame_time - 0.5 * data.hop_s, sizes)
    size = np.maximum(size, 0.15 * sizes.max())
    inside = (data.time > data.time[0] + _MARGIN_S) & (data.time < data.time[-1] - _MARGIN_S)
    priced = np.where(inside & ((gains > 0) | (not e.one_sided)), 0.5 * gains**2 / (size + 1), 0.0)
    tried = [(onset, 0.0) for onset in sorted(set(h.onsets.values()))]
    for _ in range(2):
        row = int(priced.argmax())
        if priced[row] <= 0:
            break
        tried.append((float(data.time[row]), 3.0))
        priced[np.abs(data.time - data.time[row]) < data.hop_s] = 0
    out = []
    for onset, price in tried:
        acts = h.onset_vector()
        for c in e.coordinates:
            acts[INDEX[c.name]] = onset
        free = projection(whiten(data, h.covariance, h.response(values, acts) - h.predicted))
        n, gain = float(free @ free), float(free @ projection.residual)
        if n > 1e-9 and (gain > 0 or not e.one_sided):
            alone = sum(bool(c.faint) for c in e.coordinates) == 1  # the first one is the size, the others its shape
            scaled = (start[0] * float(np.clip(gain / n, -4, 4)), *start[1:]) if alone else start
            out.append(Promise(projection.nats(free, e, start) - price, e.name, scaled, onset))
    return out


def _adjoint_rows(h: Hypothesis, projection: Projection) -> list[FloatArray]:
    """The projected residual on the rows of each channel: its inner product with a response is that of the whitened
    coefficients."""
    data = h.data
    r = projection.residual[: -projection.rows].reshape(data.channel_count, data.frame_count, data.bin_count)
    inverse = np.linalg.inv(np.linalg.cholesky(h.covariance))[data.band_of_bin]
    out = []
    for i in range(data.channel_count):
        out.append(data.adjoint(np.sum([inverse[:, c, i] * r[c] for c in range(i, data.channel_count)], axis=0)))
    return out


def limit_starts(h: Hypothesis) -> list[tuple[float, float]]:
    """Starts of both limits, from the largest commands (inverse, [s²/m])."""
    x = h["K_L"] * h.data.command
    high, low = max(float(np.percentile(x, 99.9)), 0.05), min(float(np.percentile(x, 0.1)), -0.05)
    pairs = ((0.7, 1.3), (0.4, 1.3), (1.3, 0.7), (1.3, 0.4), (0.7, 0.7))
    return [(1 / (high * f), 1 / (-low * g)) for f, g in pairs]


# finishing -----------------------------------------------------------------------------------------------------------
def other_limit(h: Hypothesis) -> Hypothesis:
    """A limit that went out of reach has no slope to come back by: each such side again from quantiles of the command,
    with a gain that the limit may have hidden."""
    if "saturation" not in h.effects:
        return h
    best, value = h, objective(h)
    command = h.data.command
    for name, most in (("drive_limit", np.percentile(command, 99.9)), ("brake_limit", -np.percentile(command, 0.1))):
        if most <= 0 or h[name] * h["K_L"] * most > 1:
            continue
        tried = []
        for k in (1.0, 1.15, 1.4, 1.8):
            for f in (0.9, 0.75, 0.6, 0.45, 0.3):
                new = h.copy()
                new["K_L"] = min(k * h["K_L"], h.limits("K_L")[1])
                new[name] = min(1 / (f * new["K_L"] * most), h.limits(name)[1])
                tried.append(new.evaluate())
        new = fit(max(tried, key=objective), 8)
        if objective(new) > value + 0.1:
            best, value = new, objective(new)
    return best


def other_ramp(h: Hypothesis) -> Hypothesis:
    """The gain's change over another time: a step found it, at the middle of what may last as long as the drive."""
    data = h.data
    first, last = float(data.time[0]), float(data.time[-1])
    ramp = math.exp(h["gain_ramp"])
    middle = h.onsets["gain_change"] + 0.5 * ramp
    tried = []
    for longer in np.geomspace(1.0, max(last - first, 2.0), _RAMPS):
        for at in (middle, middle - 0.25 * longer, middle + 0.25 * longer):
            new = h.copy()
            new["gain_ramp"] = math.log(longer)
            new.onsets["gain_change"] = min(max(at - 0.5 * longer, first), last)
            tried.append(new.evaluate())
    best = max(tried, key=objective)
    return max(h, fit(best, 6), key=objective)


def refined_onset(h: Hypothesis, effect: str) -> Hypothesis:
    """The hypothesis with the onset of one effect refined, and of those that set in with it: frames tell it roughly,
    what sets in at once sharply."""
    data = h.data
    together = [e for e, onset in h.onsets.items() if onset == h.onsets[effect]]
    first, last = float(data.time[0]) + 5, float(data.time[-1]) - 5
    begun = h.onsets[effect]
    best = h

    def moved(of: Hypothesis, onset: float) -> Hypothesis | None:
        if not first < onset < last:
            return None
        new = of.copy()
        new.onsets |= dict.fromkeys(together, onset)
        new.evaluate()
        return new if new.log_likelihood > best.log_likelihood + 0.05 else None

    for k in range(-16, 17):
        best = moved(h, begun + k * data.hop_s / 10) or best
    if best is not h:
        fit(best, 4)
    for step in (data.hop_s / 2, data.hop_s / 5, data.hop_s / 12, 0.3):
        for _ in range(3):
            before = best
            for sign in (-1, 1):
                best = moved(best, best.onsets[effect] + sign * step) or best
            if best is before:
                break
    return best if best is h else fit(best, 5)
