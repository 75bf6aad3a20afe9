"""What an engineer fits in an afternoon instead of a diagnosis: a pedal map behind a lag, boosted trees, a small
recurrent network.

Each takes stretches of command, speed and acceleration, and foretells the acceleration of a free run, whose own speed
comes back. `free_run` drives any of them, and any plant of the project, over a stretch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numba import njit
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray, IntArray
from avtorch.gap import GapPlant, plant
from benchmarks.learned.prediction import LEARNT, UNITS, WARM, Recurrent

_SMOOTH_S = 0.15  # of a speed before it is differenced
_SETTLED_S = 2.0  # of a stretch, after which filters know their past
_RIDGES = (1e-3, 1e-2, 1e-1)
_LAGS_S = (0.03, 0.08, 0.15, 0.25, 0.4, 0.6, 0.9, 1.4, 2.2)
_DELAYS_S = (0.0, 0.1, 0.2, 0.3, 0.5)
_FOLDS = 4
_BACK_S = (0.0, 0.1, 0.2, 0.4, 0.7, 1.1, 1.6)  # commands that trees see
_STEPS = 200  # of training of the network
_TREES, _RATE, _DEPTH, _BINS, _RIDGE = 150, 0.06, 4, 48, 1.0


class Stretch(NamedTuple):
    """Rows without a gap, (row,) each: command [m/s²], speed [m/s], acceleration [m/s²], and where it counts."""

    u: FloatArray
    v: FloatArray
    a: FloatArray
    ok: BoolArray

    @classmethod
    def of(cls, u: FloatArray, v: FloatArray, ok: BoolArray, dt: float) -> Stretch:
        """The acceleration is the slope of the smoothed speed."""
        width = _SMOOTH_S / dt
        return cls(u, v, gaussian_filter1d(np.gradient(gaussian_filter1d(v, width), dt), width), ok)

    def part(self, rows: slice) -> Stretch:
        """Some of the rows."""
        return Stretch(self.u[rows], self.v[rows], self.a[rows], self.ok[rows])


class Driven(Protocol):
    """A model that drives: begun at a command and a speed, then an acceleration a row."""

    def start(self, u: float, v: float, a: float) -> None: ...

    def step(self, u: float, v: float) -> float: ...


def free_run(model: Driven, part: Stretch, warm: int, dt: float) -> FloatArray:
    """Speeds (row,) [m/s] from row `warm` on, the measured one before; no car rolls back."""
    first = min(5, len(part.v) - 1)
    model.start(float(part.u[0]), float(part.v[0]), float(part.v[first] - part.v[0]) / (dt * first))
    v, out = float(part.v[0]), [float(part.v[warm])]
    for i in range(len(part.u) - 1):
        a = model.step(float(part.u[i]), v)
        v = max(v + a * dt, 0.0) if i >= warm else float(part.v[i + 1])
        if i >= warm:
            out.append(v)
    return np.array(out)


class PlantDriven:
    """A plant of the project, without what it draws by chance: of that only the mean, nothing, can be foretold."""

    def __init__(self, car: GapPlant, dt: float) -> None:
        sure = [e for e in car.effects if not e.random]
        self.plant, self.dt = plant(sure, T_L=float(car.T_L), K_L=float(car.K_L), sigma=0.0), dt

    def start(self, u: float, v: float, a: float) -> None:
        self.plant.reset()
        self.a = _scalar(a)

    def step(self, u: float, v: float) -> float:
        self.a, speed, _ = self.plant.step(self.a, _scalar(v), _scalar(u), self.dt, _scalar(0.0))
        return (float(speed) - v) / self.dt


class PedalMap:
    """Lag and delay behind a smooth map of command and speed: splines with a ridge, by cross-validation."""

    def __init__(self, parts: Sequence[Stretch], dt: float) -> None:
        u, v = (np.concatenate([getattr(p, name) for p in parts]) for name in ("u", "v"))
        self.dt = dt
        self.knots_u, self.knots_v = np.unique(np.quantile(u, (0.15, 0.4, 0.6, 0.85))), np.quantile(v, (0.2, 0.5, 0.8))
        rows = [p.ok & (np.arange(len(p.u)) * dt > _SETTLED_S) for p in parts]
        fold = np.concatenate([np.full(int(r.sum()), i % _FOLDS) for i, r in enumerate(rows)])
        y = np.concatenate([p.a[r] for p, r in zip(parts, rows, strict=True)])
        best = np.inf
        for delay in _DELAYS_S:
            bases = [self._basis(_late(p.u, round(delay / dt)), p.v) for p in parts]
            for lag in _LAGS_S:
                X = np.concatenate([_lagged(b, lag, dt)[r] for b, r in zip(bases, rows, strict=True)])
                scale = X.std(0) + 1e-9
                X = X / scale
                grams = [(X[fold == k].T @ X[fold == k], X[fold == k].T @ y[fold == k]) for k in np.unique(fold)]
                G, g = (sum((x[i] for x in grams), np.zeros(())) for i in (0, 1))
                for ridge in _RIDGES:
                    R = ridge * len(y) * np.diag([0.0] + [1.0] * (X.shape[1] - 1))
                    error = sum(
                        float(b @ A @ b - 2 * b @ c)
                        for A, c in grams
                        for b in (np.linalg.solve(G - A + R + 1e-9 * np.eye(len(R)), g - c),)
                    )
                    if error < best:
                        best, self.lag, self.delay = error, lag, round(delay / dt)
                        self.w = np.linalg.solve(G + R + 1e-9 * np.eye(len(R)), g) / scale

    def start(self, u: float, v: float, a: float) -> None:
        self.a, self.sent = self._demand(u, v), [u] * (self.delay + 1)

    def step(self, u: float, v: float) -> float:
        self.sent = [*self.sent[1:], u]
        keep = np.exp(-self.dt / self.lag)
        self.a = keep * self.a + (1 - keep) * self._demand(self.sent[0], v)
        return self.a

    def _demand(self, u: float, v: float) -> float:
        return float(self._basis(np.array([u]), np.array([v]))[0] @ self.w)

    def _basis(self, u: FloatArray, v: FloatArray) -> FloatArray:
        bent = [np.maximum(u - k, 0) for k in (0.0, *self.knots_u)] + [np.maximum(v - k, 0) for k in self.knots_v]
        return np.stack([np.ones_like(u), u, *bent, v, v * v, u * v, np.maximum(u, 0) * v], 1)


class Trees:
    """Gradient-boosted regression trees (Friedman 2001) on the speed and on past commands."""

    def __init__(self, parts: Sequence[Stretch], dt: float) -> None:
        self.dt = dt
        X = np.concatenate([self._features(p.u, p.v)[p.ok] for p in parts])
        y = np.concatenate([p.a[p.ok] for p in parts])
        self.edges = [np.unique(np.quantile(x, np.linspace(0, 1, _BINS + 1)[1:-1])) for x in X.T]
        bins = np.stack([np.searchsorted(e, x) for e, x in zip(self.edges, X.T, strict=True)], 1)
        self.base, self.trees = float(y.mean()), list[tuple[IntArray, IntArray, FloatArray]]()
        left = y - self.base
        for _ in range(_TREES):
            feature, split, value, gives = _tree(bins, left, _DEPTH, max(10, len(y) // 100), _RIDGE, _BINS)
            left = left - _RATE * gives
            self.trees.append((feature, split, _RATE * value))
        self.stacked = tuple(np.stack(x) for x in zip(*self.trees, strict=True))

    def start(self, u: float, v: float, a: float) -> None:
        self.sent = [u] * (round(_BACK_S[-1] / self.dt) + 1)
        self.slow = [u, u]

    def step(self, u: float, v: float) -> float:
        self.sent = [*self.sent[1:], u]
        keep = np.exp(-self.dt / np.array((0.3, 1.0)))
        self.slow = keep * self.slow + (1 - keep) * u
        back = [self.sent[-1 - round(s / self.dt)] for s in _BACK_S]
        x = np.array([v, *back, *self.slow])
        bins = np.array([np.searchsorted(e, xi) for e, xi in zip(self.edges, x, strict=True)])
        return self.base + float(_value(bins, *self.stacked))

    def _features(self, u: FloatArray, v: FloatArray) -> FloatArray:
        back = [_late(u, round(s / self.dt)) for s in _BACK_S]
        return np.stack([v, *back, *(_lagged(u[:, None], s, self.dt)[:, 0] for s in (0.3, 1.0))], 1)


class Network:
    """A recurrent network (`benchmarks.learned`) of command, slope and speed, fitted over free runs."""

    def __init__(self, parts: Sequence[Stretch], dt: float) -> None:
        u, a, v = (np.concatenate([getattr(p, name)[p.ok] for p in parts]) for name in ("u", "a", "v"))
        torch.manual_seed(0)
        spread = [float(x.std()) + 1e-6 for x in (u, a, v)]
        self.net, self.dt = Recurrent(dt, [float(u.mean()), 0.0, float(v.mean())], spread), dt
        drives = []
        for p in parts:
            moves = np.split(np.arange(len(p.u)), np.flatnonzero(np.diff(p.ok)) + 1)
            rows = [r for r in moves if p.ok[r[0]] and len(r) > WARM + LEARNT]
            drives += [torch.as_tensor(np.stack([p.u[r], p.v[r]], 1)).float() for r in rows]
        self.net.fit(drives, steps=_STEPS, seed=0)

    def start(self, u: float, v: float, a: float) -> None:
        self.h, self.v = torch.zeros(1, UNITS), v

    @torch.no_grad()
    def step(self, u: float, v: float) -> float:
        row = (torch.tensor([x]) for x in (u, (v - self.v) / self.dt, v))
        a, self.h = self.net(*row, self.h)
        self.v = v
        return float(a)


class Constant:
    """The speed stays what it was."""

    def start(self, u: float, v: float, a: float) -> None: ...

    def step(self, u: float, v: float) -> float:
        return 0.0


BLACK_BOXES: dict[str, Callable[[Sequence[Stretch], float], Driven]] = {
    "pedal map": PedalMap,
    "trees": Trees,
    "GRU": Network,
    "constant": lambda parts, dt: Constant(),
}
"""Black boxes by name, from taught stretches and the step [s]."""


# inside ---------------------------------------------------------------------------------------------------------------
def _scalar(x: float) -> torch.Tensor:
    return torch.tensor(float(x), dtype=torch.float64)


def _late(u: FloatArray, rows: int) -> FloatArray:
    return np.concatenate([np.full(rows, u[0]), u[: len(u) - rows]]) if rows else u


def _lagged(x: FloatArray, lag: float, dt: float) -> FloatArray:
    """First-order lag of columns (row, column), in steady state at the first row."""
    keep = np.exp(-dt / lag)
    return np.asarray(lfilter([1 - keep], [1, -keep], x, axis=0, zi=keep * x[:1])[0])


@njit(cache=True)
def _tree(  # pragma: no cover - compiled
    bins: IntArray, y: FloatArray, depth: int, least: int, ridge: float, most: int
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """One tree of `depth`: feature, split and value of each node, and what it gives (row,)."""
    nodes = 2 ** (depth + 1) - 1
    feature, split, value = np.full(nodes, -1), np.zeros(nodes, np.int64), np.zeros(nodes)
    at = np.zeros(len(y), np.int64)
    for node in range(nodes):
        rows = np.flatnonzero(at == node)
        total, count = y[rows].sum(), len(rows)
        if count == 0:
            continue
        value[node] = total / (count + ridge)
        if node >= 2**depth - 1 or count < 2 * least:
            continue
        best = total * total / (count + ridge) + 1e-12
        for f in range(bins.shape[1]):
            sums, counts = np.zeros(most + 1), np.zeros(most + 1)
            for r in rows:
                sums[bins[r, f]] += y[r]
                counts[bins[r, f]] += 1
            s = n = 0.0
            for b in range(most):
                s += sums[b]
                n += counts[b]
                if n < least or count - n < least:
                    continue
                gain = s * s / (n + ridge) + (total - s) ** 2 / (count - n + ridge)
                if gain > best:
                    best = gain
                    feature[node], split[node] = f, b
        if feature[node] >= 0:
            for r in rows:
                at[r] = 2 * node + (1 if bins[r, feature[node]] <= split[node] else 2)
    return feature, split, value, value[at]


@njit(cache=True)
def _value(  # pragma: no cover - compiled
    bins: IntArray, feature: IntArray, split: IntArray, value: FloatArray
) -> float:
    """Sum of the trees (tree, node) at one row's bins."""
    out = 0.0
    for t in range(len(feature)):
        node = 0
        while feature[t, node] >= 0:
            node = 2 * node + (1 if bins[feature[t, node]] <= split[t, node] else 2)
        out += value[t, node]
    return out
