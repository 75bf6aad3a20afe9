r"""Two sets of drives of one car as one model, so that what differs between them has a name.

    y_s = F_s D_s h[x(theta + delta_s)] + sum_j beta_j z_sj + n_s,        s = before, after

Both sides share lag, gain, dead time, effects and the free forms z of every family, one coefficient beta_j each: what
the car does on both sides, in the table or not, is no change. Each side has a recorder and a noise of its own, free in
every band. A change delta is a lag, gain or dead time of its own on the side after, an effect on one side alone, or
other parameters there of one that both share. A free form fits a shared effect but roughly, and what is left of it
looks like a change: so effects of both sides compete with those of one. Free forms are orthogonal to the shared
parameters, in units of the noise, so that lag and gain stay what they are without.

A difference that comes and goes within one side is no change between them. The blocks of a drive tell how much an
estimate scatters, the halves of either side how much the car drifts; where that is more than the likelihood says, the
likelihood is tempered down to it (a sandwich in place of the information; White 1982, Chandler and Bate 2007).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.engine.coordinates import COORDINATES, INDEX, Coordinate, EngineEffect
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.free_forms import COEFFICIENT_SD, band_products, demand_response, gram, linear_forms
from avtorch.gap.engine.gauss_newton import jacobian, normal_prior
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.inference import cleaned_drives
from avtorch.gap.engine.likelihood import HALF_LOG_2PI, claim_bands, claimed, least_noise, whiten
from avtorch.gap.engine.priors import ONE_CHANNEL_HZ
from avtorch.gap.engine.recorder import aligned, base_fit
from avtorch.gap.simulator.plant import GapPlant

Link = Literal["value", "log", "plus", "times"]
Side = Literal["before", "after", "both"]

_SCALES = {"T_L": COORDINATES["log_brake_lag"], "K_L": COORDINATES["gain_step"], "dead_time": COORDINATES["dead_time"]}
_STARTS = {"T_L": (0.0, 0.5, -0.5), "K_L": (0.0,), "dead_time": (0.0, 0.1, -0.1)}
_FEWEST_FRAMES = 3
_ROUNDS = 3  # of coefficients given the noise, noise given coefficients
_GAINS_NATS = 0.05  # a step that gains less is the last one
NOISE_COUNTS = 4.0
"""Coefficients that the noise of one car without free forms is worth, in each band: many forms would leave none."""
SIZES = (0.03, 0.1, COEFFICIENT_SD)
"""Prior standard deviations of free forms' coefficients, of which the likeliest stands [of the demand]."""
_BLOCK_S, _FEWEST_BLOCKS = 10.0, 5
NO_CHANGE = frozenset({"gain_change", "gear_shift", "command_hold", "dead_time", "~linear"})
"""What is no change of a car between drives: of one drive, of chance, or a change of T_L, K_L and dead time."""


@dataclass(frozen=True)
class JointCoordinate:
    """One coordinate of both sides: of parameter `name` on the sides it acts on; `link`: how its value enters."""

    name: str
    link: Link
    before: bool = True
    after: bool = True
    change: str = ""

    @property
    def sized(self) -> Coordinate | None:
        """The coordinate whose prior on sizes it has; None: a nuisance."""
        if not self.change:
            return None
        c = self._scale if self.link in ("times", "plus") else COORDINATES[self.name]
        return c if c.mean is None else None

    @property
    def _scale(self) -> Coordinate:
        return _SCALES.get(self.name) or COORDINATES[self.name]

    def prior(self, neutral: float) -> tuple[float, float]:
        """Mean and standard deviation of the normal prior under which it is fitted."""
        if self.link in ("times", "plus"):
            return 0.0, 4 * self._scale.scale
        if self.link == "log":
            return (math.log(0.3), 1.5) if self.name == "T_L" else (0.0, 0.5)
        return normal_prior(self.name, neutral)


@dataclass(frozen=True)
class Change:
    """One thing that differs: T_L, K_L, the dead time, or an effect on the side after (`less`: before).

    `shared`: an effect on both sides, which is no change, but what an effect on one side would be taken for; `grows`:
    such an effect has other parameters on the side after.
    """

    name: str
    coordinates: tuple[JointCoordinate, ...] = field(repr=False)
    starts: tuple[tuple[float, ...], ...] = field(repr=False)
    effect: str = ""
    less: bool = False
    shared: bool = False
    grows: bool = False

    @property
    def key(self) -> tuple[str, Side]:
        return self.name, "both" if self.shared else "before" if self.less else "after"

    def acts(self, after: bool) -> bool:
        """Whether it is an effect of that side."""
        return bool(self.effect) and not self.grows and (self.shared or self.less != after)


def of_car(name: str) -> Change:
    """A change of T_L, K_L or the dead time."""
    link: Link = "plus" if name == "dead_time" else "times"
    return Change(name, (JointCoordinate(name, link, before=False, change=name),), tuple((x,) for x in _STARTS[name]))


def of_effect(effect: EngineEffect, starts: Sequence[tuple[float, ...]], on: Side) -> Change:
    """An effect on one side alone, or on both."""
    sides = {"before": on != "after", "after": on != "before"}
    own = tuple(JointCoordinate(c.name, "value", **sides, change=effect.base) for c in effect.coordinates)
    return Change(effect.base, own, tuple(starts), effect.name, less=on == "before", shared=on == "both")


def of_growth(shared: Change, x: FloatArray) -> Change:
    """Other parameters on the side after, of an effect on both whose coordinates are `x`."""
    own = tuple(JointCoordinate(c.name, "plus", before=False, change=shared.name) for c in shared.coordinates)
    return Change(shared.name, own, (tuple(0.5 * x), tuple(-0.5 * x)), shared.effect, grows=True)


@dataclass(eq=False)
class JointFit:
    """Both sides at their likeliest values `x` (coordinate,) and coefficients `c` (column,) of the free forms.

    `sides`: hypotheses before and after, without the free forms; `noise`: covariances (band, channel, channel) of each;
    `log_likelihood`, `claimed` [nats] with the noise integrated out; `objective` with the priors.
    """

    changes: tuple[Change, ...]
    coordinates: tuple[JointCoordinate, ...]
    x: FloatArray
    c: FloatArray
    sides: tuple[Hypothesis, Hypothesis]
    noise: tuple[FloatArray, FloatArray]
    log_likelihood: float
    claimed: float
    objective: float
    information: FloatArray = field(init=False, repr=False)
    derivatives: tuple[FloatArray, FloatArray] = field(init=False, repr=False)
    evidence: float = field(init=False, default=-np.inf)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(change.name for change in self.changes)

    def at(self, change: Change) -> list[int]:
        """Places of a change's coordinates."""
        return [self.coordinates.index(c) for c in change.coordinates]


@dataclass(eq=False)
class JointModel:
    """Both sides: `whole` and its parts; `columns` (column, channel, frame, bin) of the free forms on each side."""

    whole: DriveData
    sides: tuple[DriveData, DriveData]
    base: Hypothesis
    own_effects: frozenset[str] = frozenset()
    sd: float = COEFFICIENT_SD
    columns: tuple[FloatArray, FloatArray] = field(init=False, repr=False)
    known: tuple[FloatArray, FloatArray] | tuple[None, None] = field(default=(None, None), repr=False)
    start: JointFit = field(init=False, repr=False)

    @classmethod
    def of(cls, whole: DriveData, logs_before: int, baseline: GapPlant | None) -> JointModel:
        """The fitted null model, one car: drives of which the first logs are those before.

        Raises `InputError` where a side has less than three frames.
        """
        alone = whole.channel_count == 1
        whole = whole.below(ONE_CHANNEL_HZ) if alone else whole
        base = base_fit(whole, baseline, alone=alone)
        later = aligned(base)
        if later is not None:
            whole = later
            base = base_fit(whole, baseline)
        cleaned = cleaned_drives(base)
        if cleaned is not None:
            whole = cleaned
            base = base_fit(whole, baseline, alone=alone)
        rows = whole.log >= logs_before
        if rows.all() or not rows.any():
            raise InputError(f"{'before' if rows.all() else 'after'}: has no stretch that is long enough")
        sides = whole.part(~rows), whole.part(rows)
        for name, side in zip(("before", "after"), sides, strict=True):
            if side.frame_count < _FEWEST_FRAMES:
                raise InputError(f"{name}: found {side.frame_count} frames, needs {_FEWEST_FRAMES} or more")
        own = frozenset(e.name for e in baseline.effects) if baseline is not None else frozenset[str]()
        if "dead_time" not in own:
            base.effects.append("dead_time")
        model = cls(whole, sides, base, own)
        model._begin()
        return model

    # shared ----------------------------------------------------------------------------------------------------------
    @cached_property
    def shared(self) -> tuple[JointCoordinate, ...]:
        out = [JointCoordinate("T_L", "log"), JointCoordinate("K_L", "log"), JointCoordinate("dead_time", "value")]
        for channel in self.whole.channels:
            for name in (f"{channel}_delay", f"{channel}_filter"):
                out += [JointCoordinate(name, "value", after=False), JointCoordinate(name, "value", before=False)]
        return tuple(out)

    def _begin(self) -> None:
        """Fit one car, without free forms and then with them."""
        before, after = (np.zeros((0, *side.measured.shape)) for side in self.sides)
        self._set_columns((before, after))
        lag, gain = self.base["T_L"], self.base["K_L"]
        x = np.array([self.base[c.name] for c in self.shared])
        starts = []
        for delay in (0.0, 0.06, 0.2):
            starts.append(x.copy())
            starts[-1][:3] = (
                math.log(max(lag - 0.8 * delay, min(lag, 0.06))),
                math.log(gain),
                self.base["dead_time"] + delay,
            )
        bare = max((self.fit((), s) for s in starts), key=lambda f: f.objective)
        shapes = self._free_forms(bare)
        J = self._derivatives(bare)
        both = list(zip(bare.sides, bare.noise, J, shapes, strict=True))
        inner = np.sum([gram(n, band_products(h.data, j, j)) for h, n, j, _ in both], axis=0)
        cross = np.sum([gram(n, band_products(h.data, j, x)) for h, n, j, x in both], axis=0)
        taken: FloatArray = np.asarray(np.linalg.solve(inner + np.diag(self._prior(bare.coordinates)[1]), cross), float)
        beyond = [s - np.tensordot(taken.T, j, 1) for s, j in zip(shapes, J, strict=True)]
        self._set_columns((beyond[0], beyond[1]))
        self.known = bare.noise
        each = []
        for self.sd in SIZES:
            fit = self.fit((), bare.x)
            H = self._system(fit, self._derivatives(fit))[0]
            occam = -len(fit.c) * math.log(self.sd) - 0.5 * float(np.linalg.slogdet(H)[1])
            each.append((fit.objective + occam, self.sd, fit))
        _, self.sd, self.start = max(each, key=lambda x: x[0])
        self.evaluated(self.start)

    def _set_columns(self, columns: tuple[FloatArray, FloatArray]) -> None:
        self.columns = columns
        self._inner = [band_products(data, x, x) for data, x in zip(self.sides, columns, strict=True)]

    def _free_forms(self, fit: JointFit) -> tuple[FloatArray, FloatArray]:
        """Columns of all families on each side: dynamics, force map, forces by speed, faults of the accelerometer."""
        h = Hypothesis(self.whole, values=fit.sides[0].values.copy(), neutral=self.base.neutral).evaluate()
        data = self.whole
        forms = [form.columns for form in linear_forms(h).values()]
        v = (data.smooth_speed - data.smooth_speed.mean()) / max(float(data.smooth_speed.std()), 0.1)
        forces = np.array([np.ones_like(v), v, v * v] if data.speed is not None else [np.ones_like(v)])
        forms.append(demand_response(h, forces, np.full(len(forces), 1e-3)))
        if data.channel_count == 2:
            faults = np.zeros((2, *h.predicted.shape))
            faults[0, 0], faults[1, 0] = data.transform([np.ones_like(v)])[0], h.predicted[0]
            forms.append(faults)
        columns = np.concatenate(forms)
        first = self.sides[0].frame_count
        return np.ascontiguousarray(columns[:, :, :first]), np.ascontiguousarray(columns[:, :, first:])

    # at a place ------------------------------------------------------------------------------------------------------
    def coordinates(self, changes: Sequence[Change]) -> tuple[JointCoordinate, ...]:
        return (*self.shared, *(c for change in changes for c in change.coordinates))

    def hypothesis(
        self, changes: Sequence[Change], coordinates: Sequence[JointCoordinate], x: FloatArray, after: bool
    ) -> Hypothesis:
        """One side's hypothesis at `x` (coordinate,)."""
        h = self.base.copy()
        h.data = self.sides[after]
        h.effects += [change.effect for change in changes if change.acts(after)]
        for c, value in zip(coordinates, x, strict=True):
            if not (c.after if after else c.before):
                continue
            if c.link == "plus":
                value = h[c.name] + value
            elif c.link != "value":
                value = math.exp(value) * (h[c.name] if c.link == "times" else 1.0)
            low, high = h.limits(c.name)
            h[c.name] = min(max(float(value), low), high)
        return h

    def _prior(self, coordinates: Sequence[JointCoordinate]) -> tuple[FloatArray, FloatArray]:
        """Means and precisions (coordinate,)."""
        each = np.array([c.prior(float(self.base.neutral[INDEX[c.name]])) for c in coordinates])
        return each[:, 0], each[:, 1] ** -2

    def limits(self, c: JointCoordinate) -> tuple[float, float]:
        low, high = self.base.limits(c.name)
        if c.link == "log":
            return math.log(low), math.log(high)
        return (-math.log(8), math.log(8)) if c.link == "times" else (-high, high) if c.link == "plus" else (low, high)

    def at(
        self,
        changes: tuple[Change, ...],
        x: FloatArray,
        noise: Sequence[FloatArray] | None = None,
    ) -> JointFit:
        """With the likeliest coefficients and noise at `x` (coordinate,)."""
        coordinates = self.coordinates(changes)
        sides = [self.hypothesis(changes, coordinates, x, after).evaluate() for after in (False, True)]
        noise = [h.covariance for h in sides] if noise is None else list(noise)
        count = len(self.columns[0])
        sums = []
        for h, columns, inner in zip(sides, self.columns, self._inner, strict=True):
            P = np.empty((*inner.shape[:3], 1 + count, 1 + count))
            P[..., 1:, 1:] = inner
            P[..., :1, :1] = band_products(h.data, h.residual[None], h.residual[None])
            P[..., :1, 1:] = band_products(h.data, h.residual[None], columns)
            P[..., 1:, :1] = np.swapaxes(np.swapaxes(P[..., :1, 1:], -1, -2), 1, 2)
            sums.append(P)
        c = np.zeros(count)
        for _ in range(_ROUNDS if count else 1):
            total = sum(gram(n, P) for n, P in zip(noise, sums, strict=True))
            assert isinstance(total, np.ndarray)
            c = np.asarray(np.linalg.solve(total[1:, 1:] + self.sd**-2 * np.eye(count), total[1:, 0]), float)
            left = np.concatenate([[1.0], -c])
            noise = [noise_left(P, left, h.data, k) for P, h, k in zip(sums, sides, self.known, strict=True)]
        nats, low = (
            sum(nats_of(h.data, n, k, fmax) for h, n, k in zip(sides, noise, self.known, strict=True))
            for fmax in (math.inf, None)
        )
        mean, precision = self._prior(coordinates)
        objective = nats - 0.5 * float(precision @ (x - mean) ** 2) - 0.5 * self.sd**-2 * float(c @ c)
        return JointFit(changes, coordinates, x, c, (sides[0], sides[1]), (noise[0], noise[1]), nats, low, objective)

    def _derivatives(self, fit: JointFit) -> tuple[FloatArray, FloatArray]:
        """Of each side's response by every coordinate (coordinate, channel, frame, bin)."""
        out = []
        for after, h in enumerate(fit.sides):
            acting = [c for c in fit.coordinates if (c.after if after else c.before)]
            names = list(dict.fromkeys(c.name for c in acting))
            each = dict(zip(names, jacobian(h, names), strict=True))
            J = np.zeros((len(fit.coordinates), *h.predicted.shape))
            for k, c in enumerate(fit.coordinates):
                if c in acting:
                    J[k] = each[c.name] * (h[c.name] if c.link in ("log", "times") else 1.0)
            out.append(J)
        return out[0], out[1]

    def _system(self, fit: JointFit, J: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Information (of coordinates, then columns) with priors, and the gradient at the fit."""
        n, count = len(fit.coordinates), len(fit.c)
        H, g = np.zeros((n + count, n + count)), np.zeros(n + count)
        for h, noise, j, columns, inner in zip(fit.sides, fit.noise, J, self.columns, self._inner, strict=True):
            left = self.left(fit, h)
            H[:n, :n] += gram(noise, band_products(h.data, j, j))
            H[:n, n:] += gram(noise, band_products(h.data, j, columns))
            H[n:, n:] += gram(noise, inner)
            g[:n] += gram(noise, band_products(h.data, j, left[None]))[:, 0]
            g[n:] += gram(noise, band_products(h.data, columns, left[None]))[:, 0]
        H[n:, :n] = H[:n, n:].T
        mean, precision = self._prior(fit.coordinates)
        precision = np.concatenate([precision, np.full(count, self.sd**-2)])
        g -= precision * np.concatenate([fit.x - mean, fit.c])
        return H + np.diag(precision), g

    def left(self, fit: JointFit, h: Hypothesis) -> FloatArray:
        """What a side's hypothesis and the free forms leave (channel, frame, bin)."""
        return h.residual - np.tensordot(fit.c, self.columns[fit.sides.index(h)], 1)

    # fits ------------------------------------------------------------------------------------------------------------
    def fit(self, changes: Sequence[Change], x: FloatArray, iterations: int = 8) -> JointFit:
        """Gauss-Newton from `x` (coordinate,)."""
        changes = tuple(changes)
        low, high = np.array([self.limits(c) for c in self.coordinates(changes)]).T
        now = self.at(changes, np.clip(x, low, high))
        n, damping = len(now.x), 1e-3
        for _ in range(iterations):
            H, g = self._system(now, self._derivatives(now))
            better = None
            for _ in range(5):
                A = H + np.diag(damping * np.diag(H) + 1e-12)
                step = np.linalg.solve(A, g)[:n]
                stuck = ((now.x <= low) & (step < 0)) | ((now.x >= high) & (step > 0))
                if stuck.any():
                    free = np.concatenate([~stuck, np.ones(len(g) - n, bool)])
                    step = np.zeros(len(g))
                    step[free] = np.linalg.solve(A[np.ix_(free, free)], g[free])
                    step = step[:n]
                new = self.at(changes, np.clip(now.x + step, low, high), now.noise)
                if new.objective > now.objective - 1e-9:
                    better = new
                    break
                damping = max(8 * damping, 1e-2)
            if better is None:
                break
            gain, now, damping = better.objective - now.objective, better, max(damping / 10, 1e-5)
            if gain < _GAINS_NATS:
                break
        return now

    def with_change(self, fit: JointFit, change: Change) -> JointFit:
        """The best fit with one more change, from each of its starts."""
        changes = (*fit.changes, change)
        tried = [self.fit(changes, np.concatenate([fit.x, start]), 6) for start in change.starts]
        if change.name == "dead_time" and not change.effect:  # what both sides had of it may be the one side's
            own = [c.name for c in fit.coordinates].index("dead_time")
            for start in (fit.x[own], 0.5 * fit.x[own]) if fit.x[own] > 0 else ():
                x = np.append(fit.x, start)
                x[own] -= start
                tried.append(self.fit(changes, x, 6))
        return self.evaluated(max(tried, key=lambda f: f.objective))

    def without(self, fit: JointFit, change: Change) -> JointFit:
        rest = tuple(c for c in fit.changes if c != change)
        kept = [k for k, c in enumerate(fit.coordinates) if c not in change.coordinates]
        return self.evaluated(self.fit(rest, fit.x[kept]))

    def evaluated(self, fit: JointFit) -> JointFit:
        """With its evidence over one car, by Laplace's approximation, as in `evidence`."""
        fit.derivatives = self._derivatives(fit)
        fit.information = self._system(fit, fit.derivatives)[0]
        gain = min(fit.claimed - self.start.claimed, fit.log_likelihood - self.start.log_likelihood)
        mean, precision = self._prior(fit.coordinates)
        gain -= 0.5 * self.sd**-2 * float(fit.c @ fit.c)
        for c, x, m, p in zip(fit.coordinates, fit.x, mean, precision, strict=True):
            sized = c.sized
            if sized is None:
                gain += -0.5 * p * (x - m) ** 2 + 0.5 * math.log(p) - HALF_LOG_2PI
            else:
                z = (x - m) / sized.scale
                gain += math.log(2 / (math.pi * math.sqrt(3) * sized.scale)) - 2 * math.log1p(z * z / 3)
                gain += 0.0 if c.link != "value" or sized.signed else math.log(2)
        for change in fit.changes:
            each = [(c.sized, fit.x[fit.coordinates.index(c)]) for c in change.coordinates]
            size = sum((x / c.faint) ** 2 for c, x in each if c is not None and c.faint)
            gain += max(-1 / max(size, 1e-9), -60.0) if any(c and c.faint for c, _ in each) else 0.0
        volume = len(fit.x) * HALF_LOG_2PI - 0.5 * float(np.linalg.slogdet(fit.information)[1])
        fit.evidence = gain + volume
        return fit

    @cached_property
    def blocks(self) -> int:
        """Number of blocks of the side that has fewer."""
        return min(len(blocks_of(side)) for side in self.sides)

    # how sure --------------------------------------------------------------------------------------------------------
    def covariance(self, fit: JointFit) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the coordinates: by the likelihood, by blocks of the drives, and squares of drift (coordinate,).

        Drift is what the halves of either side differ by, beyond what their blocks say.
        """
        n = len(fit.x)
        C = np.asarray(np.linalg.inv(fit.information), np.float64)
        likelihood, blocks = C[:n, :n], np.zeros((n, n))
        drift, weight = np.zeros(n), np.zeros(n)
        for k, h in enumerate(fit.sides):
            scores = block_scores(
                h, fit.noise[k], np.concatenate([fit.derivatives[k], self.columns[k]]), self.left(fit, h)
            )
            moved = C[:n] @ scores  # influence (coordinate, block)
            moved = moved - moved.mean(1, keepdims=True)
            B = moved.shape[1]
            own = moved @ moved.T * B / (B - 1)
            blocks += own
            variance = np.maximum(np.diag(own), 1e-30)
            apart = moved[:, : B // 2].sum(1) - moved[:, B - B // 2 :].sum(1)
            drift += np.maximum(apart**2 - variance, 0.0) / variance
            weight += 1 / variance
        return likelihood, blocks, 4 * drift / weight


def block_scores(h: Hypothesis, noise: FloatArray, derivatives: FloatArray, left: FloatArray) -> FloatArray:
    """Slopes of the log likelihood (parameter, block) over successive blocks of a drive.

    The transform is orthonormal, so that a product of coefficients is one of rows, of which blocks are made.
    """
    data = h.data
    shape = left.shape

    def rows(x: FloatArray) -> list[FloatArray]:
        return [data.adjoint(c) for c in whiten(data, noise, x).reshape(shape)]

    r = rows(left)
    by_row = np.array([sum(a * b for a, b in zip(rows(d), r, strict=True)) for d in derivatives])
    return np.array([by_row[:, block].sum(1) for block in blocks_of(data)]).T


def blocks_of(data: DriveData) -> list[slice]:
    """Rows under the frames, in blocks of 10 s; in shorter ones where there are less than five."""
    covered = [(i, i + (n + 1) * data.frame_rows) for i, n in data.frames]
    seconds = _BLOCK_S
    while sum(max(1, int((j - i) * data.dt / seconds)) for i, j in covered) < _FEWEST_BLOCKS:
        seconds *= 0.9
    out = []
    for i, j in covered:
        edges = np.linspace(i, j, max(1, int((j - i) * data.dt / seconds)) + 1).round().astype(int).tolist()
        out += [slice(a, b) for a, b in pairwise(edges)]
    return out


def noise_left(products: FloatArray, left: FloatArray, data: DriveData, known: FloatArray | None) -> FloatArray:
    """Covariance (band, channel, channel) of what is left of signal 0 of `products`, `known` worth `NOISE_COUNTS`."""
    S = (products @ left) @ left
    count = data.band_size[:, None, None]
    S = S / count if known is None else (S + NOISE_COUNTS * known) / (count + NOISE_COUNTS)
    S = 0.5 * (S + np.swapaxes(S, 1, 2))
    return S + least_noise(S)


def nats_of(data: DriveData, noise: FloatArray, known: FloatArray | None, fmax: float | None = math.inf) -> float:
    """Nats of the bands that begin below `fmax` [Hz], the noise integrated out under its prior."""
    nats = claimed(data, noise, fmax)
    if known is None:
        return nats
    n = claim_bands(data, fmax)
    return nats - 0.5 * NOISE_COUNTS * float(np.linalg.slogdet(noise[:n])[1].sum())
