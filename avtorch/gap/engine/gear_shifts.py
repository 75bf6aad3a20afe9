r"""Gear shifts: speeds at which driving upwards is interrupted, found by matched filter.

Where the speed rises through a level g, a positive demand loses the share `depth` for a time. Of all upshifts through a
level the demand changes by -depth p_g, p_g (row,) being the demand times the share of each row that lies in an
interruption. With score s and information A of `demand_filter`, and with the other parameters free under their priors
(derivatives J, precision N = J' S^-1 J + Lambda),

    gain of a level = -depth s~' p_g - 1/2 depth² p_g' A~ p_g,    A~ = A - Z' N^-1 Z,   Z = scores of J's columns,

s~ being the score that is left when those parameters have taken what they can (Frisch, Waugh and Lovell). Levels are
added one by one, each with its own depth (matching pursuit; Mallat and Zhang 1993). `refined_shift_speeds` moves, drops
and adds them under one common depth, level by level (coordinate ascent); only the hysteresis at which gears rearm, and
the last step, in which speeds, duration and all other parameters are fitted together, are simulated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.compiled_plant import GRID_S
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, NEUTRAL
from avtorch.gap.engine.demand_filter import (
    coordinate_from_start,
    demand_information,
    demand_score,
    frame_cover,
    information_of_coefficients,
    pulse_energy,
    take_out,
)
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit, jacobian, objective, prior_terms, whitened_jacobian
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.priors import SHIFT_NATS, WARM_S

LEVEL_STEP_MPS = 0.1
"""Distance of candidate speeds [m/s]: passed within a tenth of a second at 1 m/s², short against any interruption."""
LOWEST_MPS = 2.0
"""Lowest speed [m/s] of an upshift: below, first gears slip their clutch."""
LEAST_RATIO = 1.15
"""Least ratio of neighbouring shift speeds [-]: the closest steps of car gearboxes (Naunheimer et al. 2011, ch. 4)."""
DURATIONS_S = (0.2, 0.35, 0.6, 1.0)
"""Interruptions that are tried [s], dual clutch to automated truck gearbox; a matched filter is broad in its length."""
CAUSES_BEFORE_S, CAUSES_AFTER_S = 1.5, 2.0
"""Around an upshift a residual may be the shift's [s]: behind it the longest interruption with its lag, before it an
early crossing where the shift speed is some tenths of a metre per second too high."""

_MOST_LEVELS = 16  # as `effects.gear_shift` has it
_PASSES = 3  # of levels given parameters, parameters given levels
_NEAR_MPS = 0.6  # how far a level moves at once
_FINE_MPS = 0.02  # resolution of its place
_DISTINCT_MPS = 0.05  # smaller dips of the speed are noise
_MOST_HYSTERESIS_MPS = 4.0  # a gear that has not changed back by then never does
_PLACES = 8  # hystereses tried at once
_FINISHED = 3  # fits of each pass
_LEAST_DEPTH = 0.05  # a level that does nothing cannot be placed
_TOGETHER = ("T_L", "K_L", "shift_depth", "shift_duration")  # fitted with speeds
_LEAST_NATS = 0.5  # a change that gains less is none


def shift_speeds(h: Hypothesis) -> tuple[FloatArray, float]:
    """Speeds (gear,) [m/s], rising, at which upshifts interrupt the drive, and what they gain in all [nats].

    `h` has been evaluated, without gear shifts. Each speed has paid `SHIFT_NATS`.
    """
    best: tuple[FloatArray, float] = (np.zeros(0), 0.0)
    levels = _levels(h.data)
    if h.data.speed is None or not len(levels):
        return best
    likelihood = _PulseLikelihood.of(h)
    for duration in DURATIONS_S:
        shifts = _Shifts(likelihood, h["shift_hysteresis"], duration, {})
        nats = shifts.add_all(levels)
        if nats > best[1]:
            best = (np.array(sorted(shifts.levels)), nats)
    return best


def refined_shift_speeds(h: Hypothesis) -> Hypothesis:
    """The hypothesis, which has `gear_shift`, with its speeds, depth and hysteresis refined, fitted; `h` where nothing
    gains."""
    best = h
    for _ in range(_PASSES):
        starts = sorted(_rearmed(best), key=_objective)[-_FINISHED:]
        new = max((_pruned(fit_with_speeds(x)) for x in starts), key=_objective)
        if _objective(new) <= _objective(best) + _LEAST_NATS:
            break
        best = new
    return best


def _moved(h: Hypothesis) -> Hypothesis | None:
    """The hypothesis with levels moved, dropped and added; None where that changes nothing or leaves none."""
    depth, duration = h["shift_depth"], h["shift_duration"]
    levels = dict.fromkeys(h.shift_speeds.tolist(), depth)
    if depth < _LEAST_DEPTH:  # speeds at which nothing happens: from none
        levels, duration = {}, EFFECTS["gear_shift"].starts[0][1]
    shifts, new = _Shifts(_PulseLikelihood.of(h), h["shift_hysteresis"], duration, levels), h.copy()
    if not shifts.ascend() or not shifts.levels:
        return None
    new.shift_speeds = np.array(sorted(shifts.levels))
    new["shift_depth"], new["shift_duration"] = shifts.depth, duration
    return new.evaluate()


def _pruned(h: Hypothesis) -> Hypothesis:
    """The hypothesis without the speeds that are not worth their price."""
    for g in h.shift_speeds:
        rest = h.copy()
        rest.shift_speeds = h.shift_speeds[h.shift_speeds != g]
        if len(rest.shift_speeds) and _objective(rest.evaluate()) > _objective(h):
            h = rest
    return h


def _rearmed(h: Hypothesis) -> list[Hypothesis]:
    """The hypothesis with other hystereses, each with its levels as they are and moved: one may be wrong by what the
    other is.

    Between two depths to which the speed dips below a level and comes back, all hystereses are the same. Too small
    ones add upshifts and too large ones leave some out, so the likelihood rises up to the true one and falls behind it:
    a few places along the list are tried, then those around the best.
    """
    data = h.data
    dips = [dips_below(data.smooth_speed, data.starts, float(g)) for g in h.shift_speeds]
    edges = np.unique(np.concatenate([[_DISTINCT_MPS, _MOST_HYSTERESIS_MPS], *dips]))
    edges = edges[(edges >= _DISTINCT_MPS) & (edges <= _MOST_HYSTERESIS_MPS)]
    values = 0.5 * (edges[1:] + edges[:-1])
    best, tried, out = h, set[int](), [h]
    first, last = 0, len(values) - 1
    while True:
        places = sorted(set(np.linspace(first, last, _PLACES).round().astype(int).tolist()) - tried)
        for k in places:
            new = h.copy()
            new["shift_hysteresis"] = float(values[k])
            out.append(new.evaluate())
            best = max(best, new, key=_objective)
        tried |= set(places)
        near = int(np.abs(values - best["shift_hysteresis"]).argmin())
        left, right = [k for k in tried if k < near], [k for k in tried if k > near]
        first, last = max(left, default=0), min(right, default=len(values) - 1)
        if not places or set(range(first, last + 1)) <= tried:
            break
    likely = [best, *out[: _PLACES + 1]]
    return [*likely, *(x for x in map(_moved, likely) if x is not None)]


def fit_with_speeds(h: Hypothesis, iterations: int = 6) -> Hypothesis:
    """The hypothesis at the maximum of `objective` with its shift speeds free, too, by damped Gauss-Newton.

    An upshift is read between rows, so the response is differentiable in a speed. Speeds, depth and duration belong
    together, as an interruption that begins early looks long and shallow; the recorder's parameters are fitted last.
    """
    at = [INDEX[n] for n in _TOGETHER]
    low, high = np.array([h.limits(n) for n in _TOGETHER]).T
    h, damping = h.copy().evaluate(), 1e-3
    for _ in range(iterations):
        W = whitened_jacobian(h, np.concatenate([jacobian(h, _TOGETHER), _speed_derivatives(h)]))
        precision, pull = prior_terms(h, _TOGETHER)
        none = np.zeros(len(h.shift_speeds))
        H = W @ W.T
        g = W @ whiten(h.data, h.covariance, h.residual) + np.append(pull, none)
        better = None
        while better is None and damping < 1e3:
            A = H + np.diag(np.append(precision, none) + damping * np.diag(H) + 1e-12)
            step = np.linalg.solve(A, g)
            new = h.copy()
            new.values[at] = np.clip(h.values[at] + step[: len(at)], low, high)
            new.shift_speeds = h.shift_speeds + np.clip(step[len(at) :], -_NEAR_MPS, _NEAR_MPS)
            if (np.diff(new.shift_speeds) > 0).all() and objective(new.evaluate()) > objective(h):
                better = new
            damping = damping / 10 if better else damping * 8
        if better is None:
            break
        gain, h = objective(better) - objective(h), better
        if gain < 0.1 * _LEAST_NATS:
            break
    return fit(h, 3)


def _speed_derivatives(h: Hypothesis) -> FloatArray:
    """Derivatives (gear, channel, frame, bin) of the response by the shift speeds."""
    out = np.empty((len(h.shift_speeds), *h.predicted.shape))
    for k in range(len(h.shift_speeds)):
        responses = []
        for change in (_FINE_MPS, -_FINE_MPS):
            new = h.copy()
            new.shift_speeds = h.shift_speeds.copy()
            new.shift_speeds[k] += change
            responses.append(new.response())
        out[k] = (responses[0] - responses[1]) / (2 * _FINE_MPS)
    return out


def upshift_rows(data: DriveData, speeds: FloatArray) -> BoolArray:
    """Rows (row,) around upshifts through any of `speeds` [m/s], whose residual may be theirs."""
    out = np.zeros(len(data.time), bool)
    hysteresis = float(NEUTRAL[INDEX["shift_hysteresis"]])
    for g in speeds:
        for t in upshift_times(data.time, data.smooth_speed, data.starts, float(g), hysteresis):
            i, j = np.searchsorted(data.time, (t - CAUSES_BEFORE_S, t + CAUSES_AFTER_S))
            out[i:j] = True
    return out


def _objective(h: Hypothesis) -> float:
    return h.log_likelihood - SHIFT_NATS * len(h.shift_speeds)


def _levels(data: DriveData) -> FloatArray:
    v = data.smooth_speed
    return np.arange(max(LOWEST_MPS, math.ceil(10 * v.min()) / 10), v.max(), LEVEL_STEP_MPS)


def _apart(levels: FloatArray, others: FloatArray) -> BoolArray:
    """Which `levels` (level,) are no neighbour of any of `others`."""
    ratio = np.abs(np.log(levels[:, None] / np.asarray(others)[None, :]))
    return np.all(ratio >= math.log(LEAST_RATIO), axis=1)


# interruptions as pulses of the demand -------------------------------------------------------------------------------
class _Pulses(NamedTuple):
    """Interruptions p of full depth: `values` (element,) [m/s²] in `rows` (element,).

    `size` is p' A~ p of all together, and `others` N^-1 Z p (parameter,) what the other parameters take of them.
    """

    rows: IntArray
    values: FloatArray
    size: float
    others: FloatArray


@dataclass(frozen=True, eq=False)
class _PulseLikelihood:
    """log L as a quadratic of pulses of the demand, other parameters being free.

    `score` (row,) is s~; `columns` (parameter, row) Z; `inverse` (parameter, parameter) N^-1; `information` (lag,) of
    A and `cover` (row,) of D; `demand` (row,) [m/s²] the positive part of what drives the car; `since` [s]: when the
    effect sets in.
    """

    data: DriveData
    score: FloatArray
    columns: FloatArray
    inverse: FloatArray
    information: FloatArray
    cover: FloatArray
    demand: FloatArray
    since: float

    @classmethod
    def of(cls, h: Hypothesis) -> _PulseLikelihood:
        """The likelihood around an evaluated hypothesis."""
        data = h.data
        names = [n for n in h.free if n not in ("shift_depth", "shift_duration")]
        derivatives = jacobian(h, names)
        precision, pull = prior_terms(h, names)
        normal, gradient = information_of_coefficients(data, h.covariance, derivatives, h.residual)
        inverse = np.asarray(np.linalg.inv(normal + np.diag(precision + 1e-12)), np.float64)
        *columns, score = demand_score(h, h.covariance, np.array([*derivatives, h.residual]), dead_time=False)
        columns = np.array(columns)
        score -= (inverse @ (gradient + pull)) @ columns
        lags = round(WARM_S / data.dt)
        late = data.time - coordinate_from_start(h, "dead_time")
        demand = h["K_L"] * np.interp(late, data.time, np.maximum(h.command(), 0.0))
        information = demand_information(h, h.covariance, lags, dead_time=False)
        since = h.onsets.get("gear_shift", -math.inf)
        return cls(data, score, columns, inverse, information, frame_cover(h), demand, since)

    def upshifts(self, level: float, hysteresis: float) -> FloatArray:
        data = self.data
        times = upshift_times(data.time, data.smooth_speed, data.starts, level, hysteresis)
        return times[times >= self.since]

    def pulses(self, times: FloatArray, duration: float) -> _Pulses:
        """Of upshifts at `times` (upshift,) [s]; the plant's interruption begins a step of its grid later."""
        data = self.data
        begins = times + data.dt / (int(data.dt / GRID_S) + 1)
        rows, values = _pulses(data.time, data.starts, self.demand, begins, duration)
        across = self.columns[:, rows] @ values
        taken = self.inverse @ across
        size = pulse_energy(self.information, self.cover, rows, values) - float(across @ taken)
        return _Pulses(rows, values, size, taken)

    def gain(self, score: FloatArray, pulses: _Pulses) -> float:
        """-score' p [nats per depth]."""
        return -float(score[pulses.rows] @ pulses.values)

    def take_out(self, score: FloatArray, pulses: _Pulses, depth: float) -> None:
        """`score` beside pulses of that depth (negative: without them), in place."""
        take_out(score, self.information, self.cover, pulses.rows, pulses.values, -depth)
        score -= depth * (pulses.others @ self.columns)


class _Shifts:
    """`levels` [m/s] with a depth each, of one hysteresis [m/s] and one `duration` [s], and the `score` (row,) beside
    all of them. All gains are of changes, so that what they leave as it is need not be computed.

    Depths are free here, though the plant has one: the information is the mean over places in a frame, and what it is
    wrong by at the few upshifts of a level then changes no sign.
    """

    def __init__(
        self, likelihood: _PulseLikelihood, hysteresis: float, duration: float, levels: dict[float, float]
    ) -> None:
        self.likelihood, self.hysteresis, self.duration, self.levels = likelihood, hysteresis, duration, levels
        self.score = likelihood.score.copy()
        self._known: dict[float, _Pulses] = {}

    @property
    def depth(self) -> float:
        """The common depth, each level's weighed by its information."""
        return float(np.average(list(self.levels.values()), weights=[self._pulses(g).size for g in self.levels]))

    def ascend(self) -> bool:
        """Move, drop and add levels while that gains; whether anything did."""
        coarse = np.round(_levels(self.likelihood.data), 2)
        near = np.arange(-_NEAR_MPS, _NEAR_MPS + 1e-9, _FINE_MPS)
        total = 0.0
        for _ in range(_PASSES):
            gained = sum(self._move(g, np.round(g + near, 2)) for g in list(self.levels)) + self.add_all(coarse)
            total += gained
            if gained < _LEAST_NATS:
                break
        return total >= _LEAST_NATS

    def add_all(self, levels: FloatArray) -> float:
        """Add the best of `levels` one by one, while any is worth its price; what they gain."""
        total = 0.0
        while len(self.levels) < _MOST_LEVELS and (more := self._add(levels)) > 0.0:
            total += more
        return total

    def _pulses(self, level: float) -> _Pulses:
        if level not in self._known:
            times = self.likelihood.upshifts(level, self.hysteresis)
            self._known[level] = self.likelihood.pulses(times, self.duration)
        return self._known[level]

    def _gain(self, level: float, depth: float | None = None) -> tuple[float, float]:
        """Nats of one more level, less its price, and its depth (None: the best one)."""
        pulses = self._pulses(level)
        slope = self.likelihood.gain(self.score, pulses)
        if depth is None:
            depth = min(max(slope / pulses.size, 0.0), 1.0) if pulses.size > _LEAST_NATS else 0.0
        return depth * (slope - 0.5 * depth * pulses.size) - SHIFT_NATS, depth

    def _move(self, level: float, by: FloatArray) -> float:
        """Put the best of the levels `by` in place of one, or leave it out where none is worth its price."""
        depth = self.levels.pop(level)
        self.likelihood.take_out(self.score, self._pulses(level), -depth)
        before, _ = self._gain(level, depth)
        return self._add(np.append(by[by > LOWEST_MPS], level)) - before

    def _add(self, levels: FloatArray) -> float:
        """Add the best of `levels` apart from the others, if it is worth its price; what it gains."""
        if self.levels:
            levels = levels[_apart(levels, np.array(list(self.levels)))]
        gains = [self._gain(float(g)) for g in levels]
        if not gains or (best := max(gains))[0] <= 0.0:
            return 0.0
        level = float(levels[gains.index(best)])
        self.levels[level] = best[1]
        self.likelihood.take_out(self.score, self._pulses(level), best[1])
        return best[0]


@njit(cache=True, error_model="numpy")
def upshift_times(
    time: FloatArray, speed: FloatArray, starts: BoolArray, level: float, hysteresis: float
) -> FloatArray:
    """Times (upshift,) [s], between rows, at which the `speed` (row,) [m/s] rises through a `level`, having been
    `hysteresis` below it since the last one. A stretch that begins above it has that gear already."""
    out = np.empty(len(time))
    count = 0
    above = False
    for k in range(len(time)):
        v = max(speed[k], 0.0)
        if starts[k]:
            above = v > level
        elif not above and v > level:
            before = speed[k - 1]
            share = min(max((v - level) / (v - before), 0.0), 1.0) if v > before else 0.0
            out[count] = time[k] - share * (time[k] - time[k - 1])
            count += 1
            above = True
        above = above and v > level - hysteresis
    return out[:count].copy()


@njit(cache=True, error_model="numpy")
def dips_below(speed: FloatArray, starts: BoolArray, level: float) -> FloatArray:
    """How far (dip,) [m/s] the `speed` (row,) fell below a `level` each time before it rose above it again."""
    out = np.empty(len(speed))
    count = 0
    deepest = -1.0  # negative: above the level, or never above it in this stretch
    seen = False
    for k in range(len(speed)):
        if starts[k]:
            seen, deepest = speed[k] > level, -1.0
        elif speed[k] > level:
            if seen and deepest > 0.0:
                out[count] = deepest
                count += 1
            seen, deepest = True, -1.0
        else:
            deepest = max(deepest, level - speed[k])
    return out[:count].copy()


@njit(cache=True, error_model="numpy")
def _pulses(
    time: FloatArray, starts: BoolArray, demand: FloatArray, begins: FloatArray, duration: float
) -> tuple[IntArray, FloatArray]:
    """The lost demand (element,) and its rows: `demand` times the share of each step that lies within `duration` of
    `begins` (upshift,). None reaches into another stretch."""
    first, last = np.searchsorted(time, begins, side="right") - 1, np.searchsorted(time, begins + duration)
    rows, values = np.empty((last - first).sum(), np.int64), np.empty((last - first).sum())
    count = 0
    for e in range(len(begins)):
        for k in range(first[e], min(last[e], len(time) - 1)):
            if starts[k + 1]:
                break
            lost = min(time[k + 1], begins[e] + duration) - max(time[k], begins[e])
            rows[count], values[count] = k, demand[k] * lost / (time[k + 1] - time[k])
            count += 1
    return rows[:count], values[:count]
