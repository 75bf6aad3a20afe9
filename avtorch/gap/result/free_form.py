r"""The free form of a repaired simulator: what the car's force does beyond K u, fitted to free runs.

    F ~ N(0, (z_F A)^2 [k(u) + k(u) k(v) / 2]),    R ~ N(0, A^2 [L^2 (1 + v v') + z_R^2 k(v)])

at the knots of command and speed, k the Matern-3/2 kernel of length one standard deviation of what was driven, A the
standard deviation of the acceleration (Rasmussen and Williams 2006, 2 and 4.2). The resistance's line is vague, since
a size that is shrunk here is wrong there (2.7): at speeds that were not driven, for which there are knots too, the
table goes back to K u, and the resistance to that line. With given sizes z the coefficients minimise

    n ln(mean squared error of the speed in free runs) + b' C^-1 b,    n = taught seconds / `INDEPENDENT_S`

by Levenberg and Marquardt; the car's lag has the evidence's posterior as its prior. Sizes are those that do best on
blocks left out in two ways, dealt evenly and by likeness, of which the worse counts: laps repeat, and what was taught
nearby proves little (Roberts et al. 2017). A run is nearly linear in b, so blocks left out cost one Gram matrix.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.linalg import block_diag
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.force_map import ForceMap
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis, plant_of
from avtorch.gap.engine.priors import MAP_SIZE
from avtorch.gap.engine.sample import sample
from avtorch.gap.result.counted_rows import HORIZON_S
from avtorch.gap.result.output_error import SETTLED_S, STEP_S, Coefficients, Rows, Runs
from avtorch.gap.simulator.chain import at_place
from avtorch.gap.simulator.effect import EffectContext
from avtorch.gap.simulator.force_table import FREE_FORMS, ForceTable, ResistanceCurve
from avtorch.gap.simulator.plant import GapPlant, plant

INDEPENDENT_S = 2.0
"""Taught seconds that count as one independent error [s]: what is left of a free run wanders over a second or two."""
FORM_NATS = 1.0
"""What a free form costs by its presence [nats]."""
NO_RESISTANCE_NATS = 3.0
"""What a table without a resistance costs [nats]: where the command is a force, the car has a resistance."""
GAIN_SD = 1.0
"""Standard deviation of the gain beside a free form, about the evidence's [-]: a nominal command's unit is open."""
SIZES = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0)
"""Relative sizes z that are tried [-]."""
LINE_SIZE = max(SIZES)
"""Relative size L of a resistance's line over one standard deviation of the speed [-]: vague."""
_U_QUANTILES = (0.005, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 0.995)
_V_QUANTILES = (0.002, 0.08, 0.25, 0.5, 0.75, 0.92, 0.998)
_APART = 0.12  # standard deviations between knots, least
_BEYOND = (1.0, 3.0)  # standard deviations of the speed, from what was driven to further knots
_BLOCK_S = (4.0, 10.0)  # shortest and longest block
_BLOCKS = 10  # aimed at in short drives
_FOLDS = 10
_ROUNDS = 10  # of a fit
_DIGITS = 5  # of knots and forces behind the point
_SLACK = 1e-3  # of a covariance's diagonal


@dataclass(frozen=True)
class Sizes:
    """Relative prior sizes [-] of the resistance and of the table; 0: there is none."""

    resistance: float
    table: float

    @property
    def any(self) -> bool:
        """Whether there is a free form at all."""
        return self.resistance > 0 or self.table > 0

    @property
    def nats(self) -> float:
        """What they cost: presence, and the log-normal prior of sizes; a gain alone, its presence."""
        if not self.any:
            return FORM_NATS
        middle, spread = MAP_SIZE
        on = [z for z in (self.resistance, self.table) if z > 0]
        alone = NO_RESISTANCE_NATS if self.table > 0 and not self.resistance > 0 else 0.0
        return alone + sum(FORM_NATS + 0.5 * (np.log(z / middle) / spread) ** 2 for z in on)


_STARTS = (Sizes(0.1, 0.0), Sizes(0.3, 0.3))
_DESCENTS = 3


# the car's runs -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Car:
    """What a car without a free form does along `rows`: at ln T_L, `named` gives the mean acceleration over each step
    (row,) [m/s²]. `lag`: mean and standard deviation of ln T_L. Of gains that the table has at any size, standard
    deviations: `steep` [-], and `slope` [-], of their change over a standard deviation of the speed. `longest_s`,
    `settled_s`: see `Runs.of`.

    Of a closed loop the runs go over whole blocks, begun `before_s` [s] earlier, and errors are whitened: of each, the
    share `kept` [-] is left in the next. A resistance's line is then no vaguer than its bends: its slope is a feedback
    of the speed, which the loop has already."""

    rows: Rows
    named: Callable[[float], FloatArray] = field(repr=False)
    lag: tuple[float, float]
    steep: float = 0.0
    slope: float = 0.0
    longest_s: float = HORIZON_S
    settled_s: float = SETTLED_S
    before_s: float | None = None
    kept: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "named", cache(self.named))

    @classmethod
    def of(cls, h: Hypothesis, baseline: GapPlant | None, lag: tuple[float, float]) -> Car:
        """A hypothesis without a force map."""
        data = h.data
        assert data.speed is not None
        every = max(1, round(STEP_S / data.dt))
        each = [np.arange(i, j, every) for i, j in itertools.pairwise(data.bounds) if (j - i) // every > 2]
        source, dt = np.concatenate(each), every * data.dt
        starts = np.concatenate([np.arange(len(r)) == 0 for r in each])
        command, speed = _arriving(h, plant_of(h, baseline), source, dt), data.smooth_speed[source]
        knots_u, knots_v = knots_of(command, speed)
        rows = Rows(dt, command, speed, source, starts, knots_u, beyond(knots_v, speed))

        def named(log_lag: float) -> FloatArray:
            other = h.copy()
            other["T_L"] = float(np.exp(log_lag))
            gained, time = other.on_grid()[1], data.time[source]
            at, after = (np.interp(t, data.grid.time, gained) for t in (time, time + dt))
            last = np.append(starts[1:], True)
            after[last] = at[last]  # of no run
            return (after - at) / dt

        return cls(rows, named, lag)

    @property
    def zero(self) -> FloatArray:
        """The coefficients (table, curve, gain, ln T_L) without a free form."""
        u, v = self.rows.shape
        return np.append(np.zeros(u * v + v + 1), self.lag[0])

    @cached_property
    def runs(self) -> Runs:
        """The free runs."""
        return self._runs(None)

    @cached_property
    def runs_in_blocks(self) -> Runs:
        """The free runs of which none goes beyond its block."""
        return self._runs(self.edges)

    def _runs(self, edges: IntArray | None) -> Runs:
        if self.before_s is None:
            return Runs.of(self.rows, edges, self.longest_s, self.settled_s)
        return Runs.over_blocks(self.rows, self.edges, self.before_s, self.settled_s)

    @cached_property
    def edges(self) -> IntArray:
        """First rows of blocks of about `_BLOCK_S`, and the end of the last one (block + 1,)."""
        dt, count = self.rows.dt, len(self.rows.speed)
        length = float(np.clip(count * dt / _BLOCKS, *_BLOCK_S))
        out = [0]
        for i, j in itertools.pairwise(np.append(np.flatnonzero(self.rows.starts), count).tolist()):
            out += np.linspace(i, j, max(1, round((j - i) * dt / length)) + 1).astype(int)[1:].tolist()
        return np.array(out)


def knots_of(command: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the table is told: knots of commands and of speeds, where they were driven."""
    return _knots(command, _U_QUANTILES, zero=True), _knots(speed, _V_QUANTILES)


def beyond(driven: FloatArray, speed: FloatArray) -> FloatArray:
    """Knots of speeds (knot,) [m/s], those `driven` and some slower and faster ones."""
    spread = float(speed.std())
    slower = [v for far in reversed(_BEYOND) if (v := driven[0] - far * spread) > 0]
    return np.array([*slower, *driven, *(driven[-1] + far * spread for far in _BEYOND)])


def _arriving(h: Hypothesis, car: GapPlant, source: IntArray, step: float) -> FloatArray:
    """Commands (row,) behind the effects upstream of the actuator, as means over the steps [s] from `source` on."""
    data, out = h.data, np.empty(len(source))
    effects = [e for e in at_place(car.effects, "command") if not e.random]
    late = sum(float(e.values()[e.shift]) for e in effects if e.shift is not None)
    T_L, K_L = torch.as_tensor(car.T_L), torch.as_tensor(car.K_L)
    row_of = np.searchsorted(source, data.bounds)
    for (i, j), (a, b) in zip(itertools.pairwise(data.bounds), itertools.pairwise(row_of), strict=True):
        if a == b:
            continue
        u, t = data.command[i:j], data.time[i:j]
        speed, dt = torch.as_tensor(data.smooth_speed[i:j]), torch.tensor(data.dt)
        row = EffectContext(torch.as_tensor(t), dt, speed, None, T_L, K_L)
        for e in effects:
            if e.shift is None:
                u = e.over(torch.as_tensor(u), row).numpy()
        whole, ends = np.append(0.0, np.cumsum(u * data.dt)), np.append(t, t[-1] + data.dt)
        begins = data.time[source[a:b]] - late
        since, until = (
            np.interp(x, ends, whole) + np.minimum(x - ends[0], 0.0) * u[0]
            for x in (begins, np.minimum(begins + step, ends[-1]))
        )
        out[a:b] = (until - since) / step
    return out


def _knots(x: FloatArray, quantiles: Sequence[float], *, zero: bool = False) -> FloatArray:
    """Knots (knot,) at quantiles of `x`, two at least, and at 0 where the command changes sign."""
    at = np.quantile(x, quantiles)
    if zero and at[0] < 0 < at[-1]:
        at = np.sort(np.append(at, 0.0))
    least = max(_APART * float(x.std()), 1e-3)
    kept = [float(at[0])]
    for value in at[1:].tolist():
        if value - kept[-1] > least:
            kept.append(value)
    return np.array(kept if len(kept) > 1 else [kept[0], kept[0] + 10 * least])


def _matern(x: FloatArray) -> FloatArray:
    far = np.sqrt(3.0) * np.abs(x[:, None] - x)
    return (1.0 + far) * np.exp(-far)


# the fit --------------------------------------------------------------------------------------------------------------
class Prior:
    """Precision of the coefficients that move at given sizes: those of table and curve, the gain, and ln T_L."""

    def __init__(self, car: Car, sizes: Sizes) -> None:
        rows = car.rows
        u, v = rows.command, rows.speed
        along_u = _matern(rows.knots_u / max(float(u.std()), 1e-9))
        z = (rows.knots_v - v.mean()) / max(float(v.std()), 1e-9)
        along_v = _matern(z)
        scale = max(float(np.diff(v)[~rows.starts[1:]].std()) / rows.dt, 1e-3)
        table = np.kron(along_u, np.ones_like(along_v)) + 0.5 * np.kron(along_u, along_v)
        line = scale * (sizes.resistance if rows.loop_s is not None else LINE_SIZE * (sizes.resistance > 0))
        straight = line**2 * (1.0 + np.outer(z, z))
        gains = np.kron(np.outer(rows.knots_u, rows.knots_u), car.steep**2 + car.slope**2 * np.outer(z, z))
        blocks, moves = [], []
        for covariance, size, free in ((table, sizes.table, gains), (along_v, sizes.resistance, straight)):
            whole = (size * scale) ** 2 * covariance + free
            moves += [bool(whole.any())] * len(whole)
            if moves[-1]:
                slack = _SLACK * ((size * scale) ** 2 + car.steep**2 + car.slope**2)
                blocks.append(np.linalg.inv(whole + slack * np.eye(len(whole))))
        blocks += [np.array([[GAIN_SD**-2]]), np.array([[car.lag[1] ** -2]])]
        self.moves = np.array([*moves, True, True])
        self.precision = np.asarray(block_diag(*blocks), np.float64)
        self.mean = np.zeros(len(self.moves))
        self.mean[-1] = car.lag[0]

    def of(self, x: FloatArray) -> float:
        d = (x - self.mean)[self.moves]
        return float(d @ self.precision @ d)


_DRAWS = 400  # of the evidence's lag
_LEAST_LAG_SD = 0.02  # of its logarithm
_LAG_STEP = 0.05  # of ln T_L, for its slope


class Fit:
    """Coefficients `x` (table, curve, gain, ln T_L) with the errors (error,) and slopes (error, coefficient) there.

    `cut`: of runs of which none goes beyond its block."""

    def __init__(self, car: Car, x: FloatArray, *, cut: bool = False) -> None:
        self.car, self.x = car, x
        self.runs = car.runs_in_blocks if cut else car.runs
        self.errors, self._slopes = self._driven(x)

    @cached_property
    def slopes(self) -> FloatArray:
        """By the coefficients, that of the lag by a finite difference."""
        aside = self.x.copy()
        aside[-1] += _LAG_STEP
        return np.column_stack([self._slopes, (self._driven(aside)[0] - self.errors) / _LAG_STEP])

    @property
    def mse(self) -> float:
        """Mean squared error [m²/s²]."""
        return max(float((self.errors**2).mean()), 1e-8)

    @property
    def at(self) -> Coefficients:
        """The coefficients but for the lag."""
        return Coefficients.of(self.x[:-1], self.car.rows.shape)

    @property
    def T_L(self) -> float:
        """[s]"""
        return float(np.exp(self.x[-1]))

    def _driven(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        car = self.car
        at = Coefficients.of(x[:-1], car.rows.shape)
        errors, slopes = self.runs.drive(car.named(float(x[-1])), float(np.exp(x[-1])), at)
        if car.kept:
            return _whitened(errors, self.runs.of_run, car.kept), _whitened(slopes, self.runs.of_run, car.kept)
        return errors, slopes


def _whitened(x: FloatArray, of_run: IntArray, kept: float) -> FloatArray:
    """Of what is in the runs' rows (error, ...), what is new there: a first-order autoregression's innovations."""
    out, first = x.copy(), np.append(True, of_run[1:] != of_run[:-1])
    out[1:] -= kept * x[:-1]
    out[first] = np.sqrt(1 - kept**2) * x[first]
    return out


def fitted(car: Car, sizes: Sizes, x: FloatArray, independent: float) -> Fit:
    """Levenberg and Marquardt from `x`."""
    prior = Prior(car, sizes)
    m = prior.moves

    def cost(fit: Fit) -> float:
        return independent * np.log(fit.mse) + prior.of(fit.x)

    now, damp = Fit(car, np.where(m, x, prior.mean)), 1e-3
    for _ in range(_ROUNDS):
        J, k = now.slopes[:, m], independent / (len(now.errors) * now.mse)
        H = k * J.T @ J + prior.precision
        g = k * J.T @ now.errors + prior.precision @ (now.x - prior.mean)[m]
        for _ in range(5):
            x = now.x.copy()
            x[m] -= np.linalg.solve(H + damp * np.diag(np.diag(H)), g)
            x[-1] = np.clip(x[-1], np.log(0.02), np.log(5.0))
            new = Fit(car, x)
            gain = cost(now) - cost(new)
            if gain > 0:
                break
            damp = max(6 * damp, 1e-3)
        else:
            break
        now, damp = new, max(damp / 6, 1e-6)
        if gain < 0.01:
            break
    return now


# blocks left out ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LeftOut:
    """Ways of leaving blocks out: `told` (fold, run), runs of the fold's blocks, the others teach; `way` (fold,)."""

    told: BoolArray
    way: IntArray

    @classmethod
    def of(cls, runs: Runs, edges: IntArray) -> LeftOut | None:
        """None where there are fewer than three blocks with runs of their own."""
        block = np.searchsorted(edges, runs.counts, side="right") - 1  # of each run
        count = len(edges) - 1
        labels = [np.arange(count) % min(count, _FOLDS)]
        if count >= 6:
            labels.append(_alike(runs.rows, edges))
        each = [(w, label[block] == k) for w, label in enumerate(labels) for k in np.unique(label)]
        each = [(w, told) for w, told in each if told.any() and not told.all()]
        return cls(np.array([t for _, t in each]), np.array([w for w, _ in each])) if len(each) > 2 else None

    def squares(self, errors: Sequence[FloatArray], runs: Runs) -> FloatArray:
        """Sums of squared errors (fold,) of the told runs, each fold's of its own `errors` (error,)."""
        each = zip(errors, self.told, strict=True)
        return np.array([float((e[told[runs.of_run]] ** 2).sum()) for e, told in each])

    def worse(self, squares: FloatArray, over: FloatArray) -> float:
        """Log ratio of the summed squares (fold, ...) of told runs over those of the baseline, by the worse way."""
        ways = np.unique(self.way)
        return float(max(np.log(squares[self.way == w].sum() / over[self.way == w].sum()) for w in ways))


def _alike(runs: Rows, edges: IntArray) -> IntArray:
    """Clusters (block,) of blocks by what was driven, none with much more than a third of them (Ward 1963)."""
    rows = list(itertools.pairwise(edges.tolist()))
    x = np.array(
        [[f(y[i:j]) for y in (runs.command, runs.speed) for f in (np.mean, np.std)] for i, j in rows], np.float64
    )
    spread = np.repeat([max(float(y.std()), 1e-9) for y in (runs.command, runs.speed)], 2)
    x = (x - x.mean(0)) / spread
    out = fcluster(linkage(x, "ward"), int(np.clip(len(rows) // 3, 2, 5)), "maxclust").astype(np.int64)
    along = x @ np.linalg.svd(x, full_matrices=False)[2][0]
    for k in np.unique(out):
        own = np.flatnonzero(out == k)
        if len(own) > 0.4 * len(rows):
            out[own[np.argsort(along[own])[len(own) // 2 :]]] = out.max() + 1
    return out


class Products:
    """Sums of squares and products of errors and slopes over the runs of each fold, taught and told."""

    def __init__(self, fit: Fit, left: LeftOut) -> None:
        self.fit, runs = fit, fit.runs.of_run
        edges = np.searchsorted(runs, np.arange(len(fit.runs.first)))
        X = np.column_stack([fit.slopes, fit.errors])
        ends = np.append(edges[1:], len(X))
        grams = np.stack([X[i:j].T @ X[i:j] for i, j in zip(edges, ends, strict=True)])
        counts = (ends - edges).astype(float)
        flat = grams.reshape(len(grams), -1)
        self.taught = ((~left.told).astype(float) @ flat).reshape(-1, *grams.shape[1:])
        self.told = (left.told.astype(float) @ flat).reshape(-1, *grams.shape[1:])
        self.taught_counts = (~left.told).astype(float) @ counts
        self.seconds = (~left.told).mean(1)

    def steps(self, prior: Prior, independent: float) -> FloatArray:
        """Moves (fold, coefficient) from the fit to what the taught runs of each fold say."""
        m, x = prior.moves.copy(), self.fit.x
        m[-1] = False  # runs bend with the lag
        precision = prior.precision[:-1, :-1]
        out = np.zeros((len(self.taught), len(x)))
        at = (x - prior.mean)[m]
        outside = np.where(prior.moves, 0.0, prior.mean - x)  # what has no size goes back
        for f, (G, n, share) in enumerate(zip(self.taught, self.taught_counts, self.seconds, strict=True)):
            A, q = G[:-1, :-1], G[:-1, -1] + G[:-1, :-1] @ outside
            s = G[-1, -1] + 2 * outside @ G[:-1, -1] + outside @ A @ outside
            out[f] += outside
            A, q = A[np.ix_(m, m)], q[m]
            d = np.zeros(int(m.sum()))
            for _ in range(3):
                mse = max((s + 2 * d @ q + d @ A @ d) / n, 1e-8)
                k = share * independent / (n * mse)
                d = -np.linalg.solve(k * A + precision, k * q + precision @ at)
            out[f, m] = d
        return out

    def squares(self, steps: FloatArray) -> FloatArray:
        """Sums of squared errors (fold,) of the told runs after these moves, as far as they are linear."""
        full = np.column_stack([steps, np.ones(len(steps))])
        return np.maximum(np.einsum("fi,fij,fj->f", full, self.told, full), 1e-12)


@dataclass(frozen=True, eq=False)
class FittedForm:
    """A free form of `sizes` beside a hypothesis; without a table and a resistance it is the gain of free runs.

    `score`: on blocks left out, the logarithm of the mean squared error over that of the baseline, whose gain the same
    blocks teach, by the worse way of leaving out, with what the form costs.
    """

    hypothesis: Hypothesis
    fit: Fit = field(repr=False)
    sizes: Sizes
    score: float
    independent: float

    @property
    def words(self) -> str:
        """What it is."""
        table = ["a force map of command and speed"] if self.sizes.table > 0 else []
        curve = ["a resistance that depends on the speed"] if self.sizes.resistance > 0 else []
        return " and ".join([*table, *curve]) or "a gain that free runs teach"

    def effects(self) -> tuple[ForceTable | ResistanceCurve, ...]:
        """As effects of a plant."""
        rows, at = self.fit.car.rows, self.fit.at
        u, v, curve = (tuple(x.round(_DIGITS).tolist()) for x in (rows.knots_u, rows.knots_v, at.curve))
        table = tuple(tuple(row) for row in at.table.round(_DIGITS).tolist())
        tables = [ForceTable(u, v, table)] if self.sizes.table > 0 else []
        return (*tables, *([ResistanceCurve(v, curve)] if self.sizes.resistance > 0 else []))

    def beside(self, car: GapPlant) -> GapPlant:
        """The car with the free form, without the gust of which it takes a part: what is left of that is not known."""
        still = torch.zeros(8, dtype=torch.float64)
        kept = [e for e in car.effects if (change := e.noise(still)) is None or change.force_sd is None]
        gain = float(car.K_L) + self.fit.at.gain
        return plant([*kept, *self.effects()], T_L=self.fit.T_L, K_L=gain, sigma=float(car.sigma))

    def without(self, without: Sequence[slice]) -> FloatArray:
        """Acceleration [m/s²] on the grid that it adds to the hypothesis at `lagged`, taught by the other rows."""
        car, x = self.fit.car, self.fit.x
        rows, runs = car.rows, car.runs_in_blocks
        first, last = rows.source[runs.counts], rows.source[runs.end - 1]
        held = np.any([(last >= r.start) & (first < r.stop) for r in without], axis=0)
        if held.any() and not held.all():
            left = LeftOut(held[None], np.zeros(1, np.int64))
            x = x + Products(Fit(car, x, cut=True), left).steps(Prior(car, self.sizes), self.independent)[0]
        at = Coefficients.of(x[:-1], rows.shape)
        force = ForceMap(rows.knots_u, rows.knots_v, at.table, 0.0)(rows.command, rows.speed)
        force = force + at.gain * rows.command
        keep, lagged = np.exp(-rows.dt / self.fit.T_L), np.empty_like(force)
        begins = np.append(np.flatnonzero(rows.starts), len(force))
        for i, j in itertools.pairwise(begins):
            lagged[i:j] = lfilter([1 - keep], [1, -keep], force[i:j], zi=[keep * force[i]])[0]
        data = self.hypothesis.data
        adds = lagged + np.interp(rows.speed, rows.knots_v, at.curve)
        return np.interp(data.grid.time, data.time[rows.source], adds)

    @property
    def lagged(self) -> Hypothesis:
        """The hypothesis with the lag that the free form was fitted with."""
        h = self.hypothesis.copy()
        h["T_L"] = self.fit.T_L
        return h


def fitted_form(h: Hypothesis, baseline: GapPlant | None, bare: Hypothesis, *, named: bool) -> FittedForm | None:
    """The free form beside a hypothesis (its force map, if any, apart) that does best on blocks left out.

    `bare`: what it is scored over. None where it foretells these blocks no better than what is handed back without it:
    the hypothesis, if it is `named`, or the baseline with the evidence's gain; and where no speed was measured, blocks
    are too few, their speed falls as the command rises, or the baseline has a free form of its own.
    """
    given = () if baseline is None else baseline.effects
    if h.data.speed is None or any(isinstance(e, FREE_FORMS) for e in given):
        return None
    h, bare = _as_a_plant(h), _as_a_plant(bare)
    lags = np.log(sample(h, chains=1, draws=_DRAWS, seed=0, method="laplace")["T_L"].reshape(-1))
    car = Car.of(h, baseline, (float(np.log(h["T_L"])), max(float(lags.std()), _LEAST_LAG_SD)))
    runs = car.runs_in_blocks
    left = LeftOut.of(runs, car.edges) if len(runs.of_run) else None
    if left is None:
        return None
    independent = max(len(car.rows.speed) * car.rows.dt / INDEPENDENT_S, 3.0)
    base = Car.of(bare, baseline, (float(np.log(bare["T_L"])), 1.0))
    over = squares_of(Fit(base, base.zero, cut=True), Prior(base, Sizes(0.0, 0.0)), left, independent)
    other = car if named else base
    as_it_is = left.squares([Fit(other, other.zero, cut=True).errors] * len(left.told), runs)
    best = best_form(car, left, over, independent)
    follows = h["K_L"] + best.fit.at.gain > 0  # else free runs move against the command
    if not follows or best.score >= left.worse(as_it_is, over):
        return None
    return FittedForm(h, best.fit, best.sizes, best.score, independent)


def _as_a_plant(h: Hypothesis) -> Hypothesis:
    """Without what no plant has: a force map, unnamed linear dynamics. Its lag and gain are refitted where it had."""
    unnamed = [e for e in h.effects if e.startswith("~")]
    if not unnamed and h.force is None:
        return h
    rest = h.without_map()
    for e in unnamed:
        rest = rest.without(e)
    return fit(rest, 12) if unnamed else rest.evaluate()


def squares_of(fit: Fit, prior: Prior, left: LeftOut, independent: float) -> FloatArray:
    """Sums of squared errors (fold,) of the told runs, driven with what the other runs of each fold teach."""
    steps = Products(fit, left).steps(prior, independent)
    return left.squares([Fit(fit.car, fit.x + d, cut=True).errors for d in steps], fit.runs)


class Best(NamedTuple):
    """The best sizes, the fit at them, and `score`: how they foretell blocks left out, with what they cost."""

    score: float
    sizes: Sizes
    fit: Fit


def best_form(car: Car, left: LeftOut, over: FloatArray, independent: float, tried: Sequence[float] = SIZES) -> Best:
    """The free form of a car that does best on blocks left out; `over` (fold,): squares of the baseline there; sizes
    are of those `tried`."""
    found = []
    for sizes in _STARTS:
        if not {sizes.resistance, sizes.table} <= set(tried):
            continue
        fit = fitted(car, sizes, car.zero, independent)
        for _ in range(_DESCENTS):  # the lag follows the sizes, and these follow the lag
            products = Products(Fit(car, fit.x, cut=True), left)

            def score(z: Sizes, products: Products = products) -> float:
                squares = products.squares(products.steps(Prior(car, z), independent))
                return left.worse(squares, over) + 2 * z.nats / independent

            best = min((Sizes(r, f) for r in tried for f in tried), key=score)
            if best == sizes:
                break
            sizes = best
            fit = fitted(car, sizes, fit.x, independent)
        told = squares_of(Fit(car, fit.x, cut=True), Prior(car, sizes), left, independent)
        found.append(Best(left.worse(told, over) + 2 * sizes.nats / independent, sizes, fit))
    return min(found, key=lambda best: best.score)
