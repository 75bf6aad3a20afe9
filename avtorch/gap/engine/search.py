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

import numpy as np

from avtorch.gap.engine.coordinates import EFFECTS, EngineEffect, base_name
from avtorch.gap.engine.evidence import evaluate_evidence, gains
from avtorch.gap.engine.force_base import prices, resized, with_force_map
from avtorch.gap.engine.gauss_newton import fit, objective, penalty
from avtorch.gap.engine.gear_shifts import refined_shift_speeds, shift_speeds, upshift_rows
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.lost_messages import with_lost_messages
from avtorch.gap.engine.priors import TRIED_NATS, WITHIN_NATS
from avtorch.gap.engine.promises import later_than_the_start, promises
from avtorch.gap.engine.recorder import traded

_MOST_FITS, _FEWEST_FITS = 160, 40  # of a search; a hard case of five minutes takes about fifty
_GRID_FITS = 4e6  # fits times grid points: what a long drive may cost
_WIDTH, _LATER_WIDTH, _SECOND_WIDTH = 9, 6, 4  # effects fitted from the base, from a set, on a second way in
_FINISHED = 3  # of these, how many are finished
_BISECTIONS = 3  # of the weight of fast bands
_RAMPS = 10  # of a gain that changes, from a second to the drive's length
_LEAST_PROMISE = 1.5  # nats: less is the gain of a parameter that does nothing
_SLOW_MPS = 3.0
_SHARP = ("sensor_bias", "constant_resistance", "sensor_scale")  # effects that set in at once


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
        return max(base, self._pruned(self._put(fit(now, 10))), key=lambda h: h.score)

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
            finished_sets = [self._put(self._finish(h)) for h in grown[:finished]]
            grown = sorted([*finished_sets, *self._set_in_later(finished_sets)], key=lambda h: -h.score)
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
        kept = self.visited.get(key)
        replaced = kept is None or (kept.base is not kept and (anew or kept.score < h.score))  # gains count from a base
        if replaced:
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
        return self._claiming(h)

    def _claiming(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis where the lesser gain of two bands, which the evidence counts, is largest.

        A fit climbs all bands. Where those below 10 Hz gain less, bands above count less: of two concave gains the
        lesser is largest where some weighted mean of both is, and the weight is bisected.
        """
        best, low, high = h, 0.0, 1.0
        claim, whole = gains(h)
        if claim > whole - TRIED_NATS:
            return h
        for _ in range(_BISECTIONS):
            self.fits += 1
            upper = 0.5 * (low + high)
            new = fit(best.copy(), 10, upper=upper)
            claim, whole = gains(new)
            low, high = (low, upper) if claim < whole else (upper, high)
            if min(claim, whole) + penalty(new, new.free) > min(gains(best)) + penalty(best, best.free):
                best = new
        return best

    def _set_in_later(self, found: Sequence[Hypothesis]) -> Iterator[Hypothesis]:
        """The same sets with the last effect from a time on, where that promises more: one that is fitted over the
        whole drive shows by its values when it set in, as no start did."""
        for h in found:
            e = EFFECTS[h.effects[-1]] if h.effects else None
            rest = None if e is None else self.without(h, e.name)
            if e is None or rest is None or e.onset != "may" or e.name in h.onsets or self._ended():
                continue
            at = tuple(h[c.name] for c in e.coordinates)
            later = later_than_the_start(rest, e, at)
            if later is not None:
                yield self._put(refined_onset(self._add(rest, e.name, later.start, later.onset), e.name))

    def _pruned(self, h: Hypothesis) -> Hypothesis:
        """The best after leaving out each effect in turn, and each onset: what was refined for the last one stays."""
        while h.effects and not self._ended():
            others = []
            for e in h.effects:
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
