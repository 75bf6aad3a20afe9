"""What a black box still foretells of held-out blocks: a bound on what any model could.

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

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.free_forms import band_products
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.result.free_runs import Blocks, compared, readings, speed_gained

_LAGS_S = (0.2, 0.4, 0.8, 1.6, 3.2, 6.4)
_SMOOTH_S = 0.5  # of the speed: little of the noise of the moment is in it
_LINEAR, _MAP, _TIME = range(3)  # sets of columns, each with those before it
_BODY, _ACCEL, _SPEED = range(3)  # where a column acts
_PRIOR_SD = np.geomspace(0.001, 3.0, 12)  # of a coefficient [m/s²]
_POOLED = (1, 200)  # coefficients a channel that tell a band's noise: free bands swallow what few coefficients show
_STEPS = 4  # alternations between coefficients and noise
_DRAWS = 200  # of the posterior
_LEAST = 1e-9  # of a covariance's trace, as in `likelihood`


class Predicted(NamedTuple):
    """By the fit without each fold: `readings` (fold, channel, row), `coefficients` (fold, channel, frame, bin), and
    `possible` (draw, channel, block): draws of the squares of free runs of what may be there."""

    readings: FloatArray
    coefficients: FloatArray
    possible: FloatArray


@dataclass(frozen=True, eq=False)
class BlackBox:
    """Columns beside a hypothesis, each in a set `kind` (column,), and the `readings` (column, channel, row) and
    `coefficients` (column, channel, frame, bin) that they make."""

    hypothesis: Hypothesis
    kind: IntArray = field(repr=False)
    readings: FloatArray = field(repr=False)
    coefficients: FloatArray = field(repr=False)

    @classmethod
    def of(cls, h: Hypothesis) -> BlackBox:
        """The columns that commands, speed, time and the hypothesis's own response make."""
        signals = _signals(h)
        places = [(_BODY, _forces(h.data, signals))]
        if h.data.channel_count == 2:
            places += [(_ACCEL, _of_accelerometer(signals)), (_SPEED, _of_speed(signals))]
        each = [(place, kind, x) for place, sets in places for kind, columns in enumerate(sets) for x in columns]
        shown = np.stack([_shown(h, place, x) for place, _, x in each])
        coefficients = np.stack([h.data.transform(compared(h.data, x)) for x in shown])
        return cls(h, np.array([kind for _, kind, _ in each]), shown, coefficients)

    def predict(self, residuals: FloatArray, errors: FloatArray, blocks: Blocks) -> Predicted:
        """What the columns foretell of each fold's blocks, taught by the `residuals` (fold, channel, frame, bin) of the
        other blocks alone. `errors` (channel, row): of readings, each block's by the fit without it."""
        h, X = self.hypothesis, self.coefficients
        rng = np.random.default_rng(0)
        normal, uniform = rng.standard_normal((_DRAWS, len(X))), rng.random(_DRAWS)
        runs, left = blocks.free_runs(h.data, self.readings), blocks.free_runs(h.data, errors)
        before = blocks.sums(left**2).sum(1) + 1e-12
        alike = [(blocks.taught == pattern[:, None]).all(0) for pattern in np.unique(blocks.taught, axis=1).T]
        products = [band_products(h.data, X[:, :, frames]) for frames in alike]
        means = np.zeros((1 + len(_POOLED), len(blocks.taught), len(X)))  # the first foretells nothing
        possible = np.zeros((_DRAWS, h.data.channel_count, len(blocks.rows)))
        gains = np.zeros(means.shape[:2])
        for k, frames in enumerate(blocks.taught):
            own = np.sum([x for x, group in zip(products, alike, strict=True) if frames[group].all()], axis=0)
            taught = _Taught.of(h.data.only(frames), own, X[:, :, frames], residuals[k][:, frames])
            draws = means[0]
            for i, least in enumerate(_POOLED, 1):
                means[i, k], draws = taught.posterior(self.kind, least, normal, uniform)
            for b in np.flatnonzero(blocks.fold == k):
                for c in range(runs.shape[1]):
                    part = runs[:, c, blocks.rows[b]]
                    gram, match = part @ part.T, part @ left[c, blocks.rows[b]]
                    possible[:, c, b] = ((draws @ gram) * draws).sum(1)
                    gains[:, k] += (2 * means[:, k] @ match - ((means[:, k] @ gram) * means[:, k]).sum(1)) / before[c]
        others = gains.sum(1, keepdims=True) - gains
        rows = [np.tensordot(means[way, k], self.readings, 1) for k, way in enumerate(others.argmax(0))]
        coefficients = [h.data.transform(compared(h.data, x)) for x in rows]
        return Predicted(np.stack(rows), np.stack(coefficients), possible)


class _Taught(NamedTuple):
    """Products over taught frames, in each band: of columns (band, channel, channel, column, column), of columns and
    residual (band, channel, channel, column), of the residual (band, channel, channel)."""

    data: DriveData
    columns: FloatArray
    mixed: FloatArray
    residual: FloatArray

    @classmethod
    def of(cls, data: DriveData, columns: FloatArray, X: FloatArray, residual: FloatArray) -> _Taught:
        edges = data.band_edges[:-1]
        mixed = np.einsum("pcfk,dfk->cdpk", X, residual, optimize=True)
        squares = np.einsum("cfk,dfk->cdk", residual, residual)
        return cls(
            data,
            columns,
            np.moveaxis(np.add.reduceat(mixed, edges, axis=-1), -1, 0),
            np.moveaxis(np.add.reduceat(squares, edges, axis=-1), -1, 0),
        )

    def posterior(
        self, kind: IntArray, least: int, normal: FloatArray, uniform: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Mean (column,) and draws (draw, column) of the coefficients, from standard normal (draw, column) and uniform
        (draw,) numbers."""
        variance = _PRIOR_SD**2
        mean, pooling = np.zeros(len(kind)), _pooling(self.data.band_size, least)
        for _ in range(_STEPS):
            weights = np.linalg.inv(self._noise(mean, pooling))
            gram, match = np.tensordot(weights, self.columns, 3), np.tensordot(weights, self.mixed, 3)
            axes, logs, means = [], [], []
            for last in (_LINEAR, _MAP, _TIME):
                use = kind <= last
                values, vectors = np.linalg.eigh(gram[np.ix_(use, use)])
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

    def _noise(self, mean: FloatArray, pooling: FloatArray) -> FloatArray:
        """Covariance (band, channel, channel) of what coefficients (column,) leave, pooled over bands."""
        mixed = self.mixed @ mean
        S = self.residual - mixed - mixed.transpose(0, 2, 1) + (self.columns @ mean) @ mean
        S = np.tensordot(pooling, S, 1)
        return S + _LEAST * np.trace(S, axis1=1, axis2=2)[:, None, None] * np.eye(S.shape[1])


def _pooling(counts: IntArray, least: int) -> FloatArray:
    """(band, band): sums over bands to means over as many neighbours as have `least` coefficients together."""
    out, at = np.zeros((len(counts), len(counts))), np.arange(len(counts))
    for b in at:
        near = np.abs(at - b) <= next((w for w in at if counts[np.abs(at - b) <= w].sum() >= least), len(at))
        out[b, near] = 1 / counts[near].sum()
    return out


# what is shown -------------------------------------------------------------------------------------------------------
def _shown(h: Hypothesis, place: int, x: FloatArray) -> FloatArray:
    """Readings (channel, row) that a force (row,) [m/s²], or an error of the accelerometer or of the speed, makes."""
    if place != _BODY:
        out = np.zeros((2, len(x)))
        out[0 if place == _ACCEL else 1] = x
        return out
    acts = x[h.data.grid.row]
    return readings(h, acts, speed_gained(h.data.grid, acts))


# columns -------------------------------------------------------------------------------------------------------------
class _Signals(NamedTuple):
    """Of rows, in units of their spread: command (in that of `a`), the body's acceleration and its slopes, the speed
    (centred); time runs from -1 to 1."""

    u: FloatArray
    a: FloatArray
    jerk: FloatArray
    snap: FloatArray
    v: FloatArray
    t: FloatArray


def _signals(h: Hypothesis) -> _Signals:
    data = h.data
    gained = h.on_grid()[1][np.searchsorted(data.grid.row, np.arange(len(data.time)))]

    def back(x: FloatArray) -> FloatArray:
        """Slope over the row before."""
        out = np.diff(x, prepend=x[:1]) / np.diff(data.time, prepend=data.time[0] - data.dt)
        out[data.starts] = 0.0
        return out

    a = back(gained)
    jerk = data.low_pass(back(a), 0.1)
    snap = data.low_pass(back(jerk), 0.1)
    u = np.where(data.starts, data.command, np.roll(data.command, 1))
    v = data.low_pass(data.smooth_speed, _SMOOTH_S)
    t = 2 * (data.time - data.time.mean()) / max(float(np.ptp(data.time)), 1e-9)
    spread = max(float(a.std()), 1e-3)
    return _Signals(u / spread, a / spread, _unit(jerk), _unit(snap), (v - v.mean()) / max(float(v.std()), 0.1), t)


def _unit(x: FloatArray) -> FloatArray:
    return x / max(float(x.std()), 1e-9)


Sets = tuple[list[FloatArray], list[FloatArray], list[FloatArray]]
"""Columns (row,) in sets: linear in command and response, maps, and what changes with time."""


def _forces(data: DriveData, signals: _Signals) -> Sets:
    u, a, jerk, snap, v, t = signals
    lp = data.low_pass
    linear = [np.ones_like(a), u, a, jerk, snap, *(lp(u, lag) for lag in _LAGS_S)]
    one_sided = [np.minimum(a, 0.0), np.where(a < 0, jerk, 0.0), *(lp(np.minimum(u, 0.0), lag) for lag in (0.2, 0.8))]
    play = [np.tanh(4 * a), np.tanh(jerk), lp(np.tanh(4 * jerk), 0.3)]
    speed = [*_hats(v, 5), *(a * x for x in _hats(v, 5)), jerk * v]
    return linear, [*one_sided, *play, *_hats(a, 9), *speed], [t, t**2, a * t, a * t**2, a * t**3]


def _of_accelerometer(signals: _Signals) -> Sets:
    _, a, jerk, snap, v, t = signals
    return [np.ones_like(a), a, jerk, snap], [np.minimum(a, 0.0), *_hats(v, 3), a * v, np.tanh(jerk)], [t, a * t]


def _of_speed(signals: _Signals) -> Sets:
    _, a, _, _, v, _ = signals
    return [a], [np.minimum(a, 0.0), a * v, *_hats(v, 3)], []


def _hats(x: FloatArray, count: int) -> list[FloatArray]:
    """Linear splines (row,) that sum to one, on equidistant knots over the range of `x`: nothing extrapolates."""
    at = (count - 1) * (x - x.min()) / max(float(np.ptp(x)), 1e-9)
    return [np.maximum(1 - np.abs(at - k), 0.0) for k in range(count)]
