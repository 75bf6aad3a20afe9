"""Nested hypotheses on held-out blocks: errors of free runs, and log densities, by fits to the other blocks alone.

The fits of the folds begin at the fit to all blocks and share its Jacobian (Gauss-Newton with a fixed slope, the chord
method), so a fold costs three simulations. The predictive density of a held-out frame has the noise's covariance
integrated out, as the likelihood has: with n coefficients a channel, of products A, taught in a band, and m, of
products B, held out,

    log p(B | A) = n/2 log det A - (n + m)/2 log det (A + B) + log Gamma_C((n + m)/2) - log Gamma_C(n/2) - m C/2 log pi

(matrix Student; Gelman et al. 2013, 3.6). No free run foretells which messages are lost, so all have arrived.

What a black box still foretells of held-out blocks: a bound on what any model could.

    r = X beta + n,    beta ~ N(0, sd^2),    X: what forces that commands, speed and time could make do to all channels

r is what a hypothesis leaves, in lapped coefficients; the noise's covariance is free in every band and estimated anew,
as everywhere. Columns look back only, over the whole band: in a closed loop a command answers the noise of the moment,
and the cross terms cancel over all frequencies (Ljung 1999, 13.4). A regression of the errors of free runs themselves
would foretell noise from its echo. A force shows in both channels, a fault of the accelerometer in its own alone.

Columns are of size one and stand in three sets, each with those before it. Sets and prior sizes are averaged by their
evidence from the taught blocks, so the regression vanishes where there is no structure (MacKay 1992). What it could
have missed is the spread of its posterior.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.special import multigammaln  # pyright: ignore[reportAttributeAccessIssue]

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap.engine.coordinates import INDEX, base_name
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.family import family_of
from avtorch.gap.engine.free_forms import band_products, gram
from avtorch.gap.engine.gauss_newton import fit, linear_priors, linearised, penalty
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import band_covariance, least_noise, whiten
from avtorch.gap.result.counted_rows import HORIZON_S, Blocks, compared, measured_readings, readings, speed_gained
from avtorch.gap.result.free_form import FittedForm

_STEPS = 3  # of a fold's fit
_DAMPED = (1.0, 0.3, 0.1)  # of a step that loses
_RANDOM = "command_hold"  # the one effect of a plant that chance decides

_LAGS_S = (0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
_SMOOTH_S = 0.5  # of the speed: little of the noise of the moment is in it
_LINEAR, _MAP, _TIME = range(3)  # sets of columns, each with those before it
_BODY, _ACCEL, _SPEED = range(3)  # where a column acts
_PRIOR_SD = np.geomspace(0.001, 3.0, 12)  # of a coefficient [m/s²]
_POOLED = 200  # coefficients a channel that tell a band's noise: free bands swallow what few coefficients show
_ROUNDS = 4  # alternations between coefficients and noise
_BOX_DRAWS = 200  # of the posterior


@dataclass(frozen=True, eq=False)
class Scores:
    """Of one model: sums of squared errors of free runs (channel, block) [(m/s²)², (m/s)²], and of log densities
    (block,) [nats]."""

    squares: FloatArray
    nats: FloatArray

    def no_worse_than(self, other: Scores) -> Scores:
        """The better of two in each channel, and in nats."""
        less = (self.squares.sum(1) < other.squares.sum(1))[:, None]
        better = max(self, other, key=lambda scores: scores.nats.sum())
        return Scores(np.where(less, self.squares, other.squares), better.nats)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A chain of nested hypotheses on blocks that taught neither their parameters nor their noise.

    `steps`: scores of each hypothesis of `chain`, then of the last one with the `free` form, if there is one; `rival`,
    `ceiling`: of the last and the first hypothesis with a black box on top. `possible` (draw, channel, block): squares
    of free runs of what the black box may have missed. `horizon_s` of the free runs. `apart`: of the last step without
    a family of causes, by its name, everything else refitted.
    """

    chain: tuple[Hypothesis, ...]
    blocks: Blocks
    steps: tuple[Scores, ...]
    rival: Scores
    ceiling: Scores
    possible: FloatArray = field(repr=False)
    horizon_s: float
    free: bool = False
    apart: Mapping[str, Scores] = field(default_factory=dict, repr=False)

    @property
    def data(self) -> DriveData:
        return self.chain[-1].data

    @property
    def names(self) -> tuple[str, ...]:
        """The effects by the table's names, in the order in which they enter; the free form, without a name, last."""
        steps = pairwise(self.chain)
        entered = (next(base_name(e) for e in _sized(b) if e not in a.effects) for a, b in steps)
        return (*entered, *(["free form"] if self.free else []))

    @property
    def floor(self) -> Scores:
        """The rival's, no higher than the last step in any channel."""
        return self.rival.no_worse_than(self.steps[-1])

    def energy(self, scores: Scores) -> FloatArray:
        """Squared errors (block,) of free runs, each channel over its own floor, averaged over the channels."""
        scale = np.maximum(self.floor.squares.mean(1), 1e-12)[:, None]
        return (scores.squares / scale).mean(0)

    @property
    def frame_rows(self) -> FloatArray:
        """Rows (block,) that the densities are of: one hop a frame."""
        frames = np.bincount(self.blocks.block_of_frame, minlength=len(self.blocks.rows))
        return np.asarray(frames * float(self.data.frame_rows), np.float64)


def held_out_errors(
    base: Hypothesis, full: Hypothesis, visited: Iterable[Hypothesis], free: FittedForm | None, *, named: bool
) -> HeldOut | None:
    """The scores of nested hypotheses from `base` to `full`, fitted to all blocks; fits among `visited` are taken as
    they are.

    `free`: a form beside the last, `named` or not, which the repaired simulator carries where it `gains`: what it
    leaves is the last step. None where the drives are too short for `FEWEST` blocks.
    """
    data = full.data
    blocks = Blocks.of(data)
    if blocks is None:
        return None
    chain = [_without_chance(h) for h in _nested(base, full, visited, blocks)]
    rows = [_taught(h, blocks) for h in chain]
    steps = [_scores(data, blocks, x) for x in rows]
    boxes = [black_box(chain[k], rows[k], blocks) for k in (-1, 0)]
    rival, ceiling = (_scores(data, blocks, rows[k] + box, rows[k]) for k, (box, _) in zip((-1, 0), boxes, strict=True))
    if free is not None:
        carried = _scores(data, blocks, _with_form(free, free.lagged, blocks))
        free = free if gains(carried, steps[0], steps[-1] if named else None) else None
        steps += [] if free is None else [carried]
    return HeldOut(
        chain=tuple(chain),
        blocks=blocks,
        steps=tuple(steps),
        rival=rival,
        ceiling=ceiling.no_worse_than(steps[0]),
        possible=boxes[0][1],
        horizon_s=min(HORIZON_S, max(rows.stop - rows.start for rows in blocks.rows) * data.dt),
        free=free is not None,
        apart=_apart(chain[-1], steps, blocks, free),
    )


def gains(carried: Scores, base: Scores, named: Scores | None) -> bool:
    """Whether a free form lowers the errors of free runs, against the baseline and against names alone, where there are
    any; its size was chosen by other ways of leaving out."""
    others = [x for x in (base, named) if x is not None]
    now, *than = (float((x.squares.sum(1) / base.squares.sum(1)).mean()) for x in (carried, *others))
    return now < min(than)


def _apart(full: Hypothesis, scored: Sequence[Scores], blocks: Blocks, free: FittedForm | None) -> dict[str, Scores]:
    """Scores without each family that acts in a free run, the free form being one of the force maps."""
    families: dict[str, list[str]] = {}
    for e in _sized(full):
        families.setdefault(family_of(base_name(e)), []).append(e)
    out = {}
    for family, own in families.items():
        rest = full
        for e in own:
            rest = _less(rest, e)
        beside = None if family == "force map" else free
        if len(own) == len(_sized(full)) and beside is None:
            out[family] = scored[0]  # the bare baseline
            continue
        rest = fit(rest, 6, 0.1)
        if beside is None:
            out[family] = _scores(rest.data, blocks, _taught(rest, blocks))
        else:
            rest["T_L"] = float(np.clip(beside.fit.T_L * rest["T_L"] / full["T_L"], *rest.limits("T_L")))
            out[family] = _scores(rest.data, blocks, _with_form(beside, rest, blocks))
    if free is not None and "force map" not in out:
        out["force map"] = scored[-2]
    return out


def _nested(base: Hypothesis, full: Hypothesis, visited: Iterable[Hypothesis], blocks: Blocks) -> list[Hypothesis]:
    """A chain from `base` to `full`, one more effect at a time, those without which free runs are worst first.

    From `full` on the effect leaves that free runs miss least, all others refitted. What chance decides enters with the
    first effect. Runs are those of the fit: the order is no score.
    """
    known = {_key(h): h for h in visited}
    floor = _run_squares(full, blocks)
    chain = [full]
    while len(_sized(chain[-1])) > 1:
        now = chain[-1]
        rest = {e: known.get(_key(now, e)) or fit(_less(now, e), 6, 0.1) for e in _sized(now)}
        cost = {e: float((_run_squares(h, blocks) / floor).mean()) for e, h in rest.items()}
        chain.append(rest[min(cost, key=lambda e: cost[e])])
    return [base, *(reversed(chain) if _sized(full) else ())]


# fits -----------------------------------------------------------------------------------------------------------------
def _taught(h: Hypothesis, blocks: Blocks) -> FloatArray:
    """Readings (fold, channel, row) by the fits without each fold."""
    slopes, *_ = linearised(h, h.free)
    rows = []
    for frames in blocks.taught:
        fold, taught = h.copy(), _fold_fit(h, slopes, frames)
        fold.values, fold.force_coefficients = taught.values, taught.force_coefficients
        rows.append(readings(fold, *fold.on_grid()))
    return np.array(rows)


def _fold_fit(h: Hypothesis, slopes: FloatArray, frames: BoolArray) -> Hypothesis:
    """Fitted to some `frames`, `slopes` (unknown, channel, frame, bin) being those of the whole fit.

    What stands at a limit stays there.
    """
    names = h.free
    low, high = np.array([h.limits(n) for n in names]).T
    at = np.array([INDEX[n] for n in names])
    moves = (h.values[at] > low) & (h.values[at] < high)
    names, at, low, high = [n for n, m in zip(names, moves, strict=True) if m], at[moves], low[moves], high[moves]
    slopes = slopes[np.append(moves, np.ones(len(slopes) - len(moves), bool))][:, :, frames]
    now = h.on(h.data.only(frames))
    for _ in range(_STEPS):
        W = np.array([whiten(now.data, now.covariance, x) for x in slopes])
        precision, pull = linear_priors(now, names)
        step = np.linalg.solve(
            W @ W.T + np.diag(precision + 1e-12), W @ whiten(now.data, now.covariance, now.residual) + pull
        )
        value = now.log_likelihood + penalty(now, names)
        for share in _DAMPED:
            new = now.copy()
            new.values[at] = np.clip(now.values[at] + share * step[: len(at)], low, high)
            new.force_coefficients = now.force_coefficients + share * step[len(at) :]
            new.evaluate()
            if new.log_likelihood + penalty(new, names) > value:
                now = new
                break
        else:
            break
    return now


def _without_chance(h: Hypothesis) -> Hypothesis:
    """The hypothesis with all messages arrived, evaluated."""
    if not h.lost:
        return h
    other = h.copy()
    other.lost = ()
    return other.evaluate()


def _sized(h: Hypothesis) -> list[str]:
    """Effects with a name that a free run shows."""
    return [e for e in h.effects if e != _RANDOM and not e.startswith("~")]


def _key(h: Hypothesis, without: str | None = None) -> frozenset[tuple[str, bool]]:
    return frozenset((e, e in h.onsets) for e in h.effects if e != without)


def _less(h: Hypothesis, effect: str) -> Hypothesis:
    rest = h.without(effect)
    if effect == "dead_time":  # what was a delay is a lag now
        rest["T_L"] += 0.8 * h["dead_time"]
    return rest


def _with_form(free: FittedForm, h: Hypothesis, blocks: Blocks) -> FloatArray:
    """Readings (fold, channel, row) of a hypothesis with the free form beside it, which each fold's other blocks
    teach."""
    (accel, gained), rows = h.on_grid(), []
    for k in range(len(blocks.taught)):
        adds = free.without([own for own, fold in zip(blocks.rows, blocks.fold, strict=True) if fold == k])
        rows.append(readings(h, accel + adds, gained + speed_gained(h.data.grid, adds)))
    return np.array(rows)


# scores --------------------------------------------------------------------------------------------------------------
def _scores(data: DriveData, blocks: Blocks, rows: FloatArray, noise: FloatArray | None = None) -> Scores:
    """Errors of free runs of readings `rows` (fold, channel, row) by fits without each fold, and densities by the noise
    that these leave on the other blocks, or that the readings `noise` do."""
    left = _residuals(data, rows)
    taught = left if noise is None else _residuals(data, noise)
    fold = blocks.fold[blocks.block_of_frame]
    nats = np.zeros(len(fold))
    for k, frames in enumerate(blocks.taught):
        own = fold == k
        nats[own] = _log_density(data.only(frames), taught[k][:, frames], left[k][:, own])
    errors = blocks.stitched(measured_readings(data) - rows)
    return Scores(
        blocks.sums(blocks.free_runs(data, errors) ** 2),
        np.asarray(np.bincount(blocks.block_of_frame, nats, len(blocks.rows)), np.float64),
    )


def _residuals(data: DriveData, rows: FloatArray) -> FloatArray:
    """Residuals (fold, channel, frame, bin) of readings (fold, channel, row), of all frames."""
    return np.array([data.measured - data.transform(compared(data, x)) for x in rows])


def _run_squares(h: Hypothesis, blocks: Blocks) -> FloatArray:
    """Mean squared errors (channel,) of free runs by a fit to all blocks."""
    h = _without_chance(h)
    errors = measured_readings(h.data) - readings(h, *h.on_grid())
    return blocks.sums(blocks.free_runs(h.data, errors) ** 2).sum(-1) + 1e-12


def _log_density(taught: DriveData, residual: FloatArray, held_out: FloatArray) -> FloatArray:
    """Log densities (frame,) of `held_out` (channel, frame, bin), given the taught frames' `residual`."""
    C, n = taught.channel_count, taught.band_size.astype(float)
    A = band_covariance(taught, residual) * n[:, None, None]
    A = A + least_noise(A)
    products = held_out[:, None] * held_out[None]
    B = np.moveaxis(np.add.reduceat(products, taught.band_edges[:-1], axis=-1), (0, 1), (-2, -1))
    m = np.diff(taught.band_edges)
    log_det, joint = np.linalg.slogdet(A)[1], np.linalg.slogdet(A + B)[1]
    constant = multigammaln(0.5 * (n + m), C) - multigammaln(0.5 * n, C) - 0.5 * m * C * math.log(math.pi)
    return (0.5 * n * log_det - 0.5 * (n + m) * joint + constant).sum(-1)


# the black box --------------------------------------------------------------------------------------------------------
def black_box(h: Hypothesis, rows: FloatArray, blocks: Blocks) -> tuple[FloatArray, FloatArray]:
    """What a black box beside `h` foretells of each fold's blocks, taught by what the readings `rows` (fold, channel,
    row) leave on the other blocks alone: readings (fold, channel, row), and draws (draw, channel, block) of the squares
    of free runs of what may be there."""
    residuals = _residuals(h.data, rows)
    kind, shown = _columns(h)
    X = np.stack([h.data.transform(compared(h.data, x)) for x in shown])
    rng = np.random.default_rng(0)
    normal, uniform = rng.standard_normal((_BOX_DRAWS, len(X))), rng.random(_BOX_DRAWS)
    runs = blocks.free_runs(h.data, shown)
    foretold = []
    possible = np.zeros((_BOX_DRAWS, h.data.channel_count, len(blocks.rows)))
    for k, frames in enumerate(blocks.taught):
        taught = h.data.only(frames)
        products = band_products(taught, np.concatenate([residuals[k][None], X])[:, :, frames])
        mean, draws = _posterior(products, kind, taught.band_size, normal, uniform)
        foretold.append(np.tensordot(mean, shown, 1))
        for b in np.flatnonzero(blocks.fold == k):
            for c in range(runs.shape[1]):
                part = runs[:, c, blocks.rows[b]]
                possible[:, c, b] = ((draws @ (part @ part.T)) * draws).sum(1)
    return np.stack(foretold), possible


def _posterior(
    products: FloatArray, kind: IntArray, counts: IntArray, normal: FloatArray, uniform: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Mean (column,) and draws (draw, column) of the coefficients of columns in sets `kind` (column,).

    `products` (band, channel, channel, signal, signal) over taught frames: of the residual, and then of the columns;
    `counts` (band,) of coefficients a channel; draws are made of standard normal (draw, column) and uniform (draw,)
    numbers.
    """
    variance = _PRIOR_SD**2
    mean, pooling = np.zeros(len(kind)), _pooling(counts, _POOLED)
    for _ in range(_ROUNDS):
        left = np.append(1.0, -mean)
        noise = np.tensordot(pooling, (products @ left) @ left, 1)
        weighted = gram(noise + least_noise(noise), products)
        match, columns = weighted[1:, 0], weighted[1:, 1:]
        axes, logs, means = [], [], []
        for last in (_LINEAR, _MAP, _TIME):
            use = kind <= last
            values, vectors = np.linalg.eigh(columns[np.ix_(use, use)])
            own = vectors.T @ match[use]
            taken = variance[:, None] / (1 + variance[:, None] * np.maximum(values, 0.0))  # posterior variances
            logs.append(0.5 * (own**2 * taken + np.log(taken / variance[:, None])).sum(1))
            whole = np.zeros((len(kind), len(values)))
            whole[use] = vectors
            axes.append((whole, taken))
            means.append((own * taken) @ whole.T)
        log = np.concatenate(logs)
        chance = np.exp(log - np.logaddexp.reduce(log))
        mean = chance @ np.concatenate(means)
    drawn = np.minimum(np.searchsorted(np.cumsum(chance), uniform), len(chance) - 1)
    draws = np.concatenate(means)[drawn]
    for i, at in enumerate(drawn):
        whole, taken = axes[at // len(variance)]
        draws[i] += whole @ (np.sqrt(taken[at % len(variance)]) * normal[i, : whole.shape[1]])
    return mean, draws


def _pooling(counts: IntArray, least: int) -> FloatArray:
    """(band, band): sums over bands to means over as many neighbours as have `least` coefficients together."""
    out, at = np.zeros((len(counts), len(counts))), np.arange(len(counts))
    for b in at:
        near = np.abs(at - b) <= next((w for w in at if counts[np.abs(at - b) <= w].sum() >= least), len(at))
        out[b, near] = 1 / counts[near].sum()
    return out


def _columns(h: Hypothesis) -> tuple[IntArray, FloatArray]:
    """The set of each column (column,), and the readings (column, channel, row) that it makes: as a force on the body,
    an error of the accelerometer, or one of the speed.

    They are of the command (in units of the acceleration), the body's acceleration and its slopes, the speed (centred),
    all over their spreads, and of the time from -1 to 1.
    """
    data, lp = h.data, h.data.low_pass
    gained = h.on_grid()[1][np.searchsorted(data.grid.row, np.arange(len(data.time)))]

    def back(x: FloatArray) -> FloatArray:
        """Slope over the row before."""
        out = np.diff(x, prepend=x[:1]) / np.diff(data.time, prepend=data.time[0] - data.dt)
        out[data.starts] = 0.0
        return out

    a = back(gained)
    jerk = lp(back(a), 0.1)
    snap = lp(back(jerk), 0.1)
    u = np.where(data.starts, data.command, np.roll(data.command, 1))
    v = lp(data.smooth_speed, _SMOOTH_S)
    t = 2 * (data.time - data.time.mean()) / max(float(np.ptp(data.time)), 1e-9)
    spread = max(float(a.std()), 1e-3)
    u, a, v = u / spread, a / spread, (v - v.mean()) / max(float(v.std()), 0.1)
    jerk, snap = (x / max(float(x.std()), 1e-9) for x in (jerk, snap))
    one = np.ones_like(a)

    one_sided = [np.minimum(a, 0.0), np.where(a < 0, jerk, 0.0), *(lp(np.minimum(u, 0.0), lag) for lag in (0.2, 0.8))]
    play = [np.tanh(4 * a), np.tanh(jerk), lp(np.tanh(4 * jerk), 0.3)]
    by_speed = [*_hats(v, 5), *(a * x for x in _hats(v, 5)), jerk * v]
    places = {
        _BODY: (
            [one, u, a, jerk, snap, *(lp(u, lag) for lag in _LAGS_S)],
            [*one_sided, *play, *_hats(a, 9), *by_speed],
            [t, t**2, a * t, a * t**2, a * t**3],
        )
    }
    if data.channel_count == 2:
        places[_ACCEL] = (
            [one, a, jerk, snap],
            [np.minimum(a, 0.0), *_hats(v, 3), a * v, np.tanh(jerk)],
            [t, a * t],
        )
        places[_SPEED] = [a], [np.minimum(a, 0.0), a * v, *_hats(v, 3)], []
    kinds, shown = [], []
    for place, sets in places.items():
        for kind, columns in enumerate(sets):
            kinds += [kind] * len(columns)
            shown += [_shown(h, place, x) for x in columns]
    return np.array(kinds), np.stack(shown)


def _shown(h: Hypothesis, place: int, x: FloatArray) -> FloatArray:
    """Readings (channel, row) that a force (row,) [m/s²], or an error of the accelerometer or of the speed, makes."""
    if place != _BODY:
        out = np.zeros((2, len(x)))
        out[0 if place == _ACCEL else 1] = x
        return out
    acts = x[h.data.grid.row]
    return readings(h, acts, speed_gained(h.data.grid, acts))


def _hats(x: FloatArray, count: int) -> list[FloatArray]:
    """Linear splines (row,) that sum to one, on equidistant knots over the range of `x`: nothing extrapolates."""
    at = (count - 1) * (x - x.min()) / max(float(np.ptp(x)), 1e-9)
    return [np.maximum(1 - np.abs(at - k), 0.0) for k in range(count)]
