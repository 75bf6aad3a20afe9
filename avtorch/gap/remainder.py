"""What even the best candidate leaves over: the absolute check behind `unknown`.

A candidate may win by thousands of nats and still be wrong, when the cause is not in the table. So the winner's white
errors are asked, by size and on held-out blocks, whether something flexible still finds structure in them: forces and
sensor faults that are smooth functions of command, acceleration, speed, their recent past and time; a line in the
spectrum; correlation from row to row; bursts.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from avtorch.gap.innovations import Whitener

Float = NDArray[np.float64]

_FOLDS = 8


@dataclass(frozen=True)
class Remainder:
    """Nats that are left: `flexible` on held-out blocks by a ridge regression, of which `worth` a row in units of 1e-3;
    `line` of the strongest spectral line over what chance gives, `memory` by an autoregression on held-out blocks,
    `bursts` by a variance that changes with time, `tails` of a heavier distribution.
    """

    flexible: float
    line: float
    memory: float
    bursts: float
    tails: float

    def vector(self) -> Float:
        return np.array([getattr(self, f.name) for f in fields(self)])


def remainder(white: Whitener, errors: Float, rollout: Float) -> Remainder:
    """Of errors (witness, counted, group) of a candidate whose rollout is (witness, counted, group)."""
    mean = errors.mean(-1, keepdims=True)
    e = white(mean)[..., 0]
    count, rows = e.shape
    columns = white(_columns(white, rollout.mean(-1))[..., None])[..., 0]
    blocks = _blocks(white)
    return Remainder(
        flexible=_heldout(columns.reshape(len(columns), count, rows), e, blocks),
        line=_line(e),
        memory=_memory(e, blocks),
        bursts=_bursts(e),
        tails=_tails(e),
    )


def _blocks(white: Whitener) -> NDArray[np.int64]:
    """Fold of each counted row: blocks of some 10 s in turn, or a twentieth of the drive if that is shorter."""
    rows = white.record.rows
    length = max(2, min(round(10 / white.record.dt), rows // (2 * _FOLDS)))
    return (np.arange(rows) // length) % _FOLDS


def _columns(white: Whitener, rollout: Float) -> Float:
    """Flexible forces and faults as errors they would make, (column, witness, counted)."""
    record = white.record
    dt = record.dt
    u = record.command[record.source]
    witnesses = record.witnesses
    a = rollout[0] if "accel" in witnesses else np.asarray(lfilter([dt / 0.4], [1, dt / 0.4 - 1], u))
    moved = np.diff(a, prepend=a[0]) / dt
    v = gaussian_filter1d(record.measured[-1].mean(-1), 0.5 / dt) if "speed" in witnesses else np.zeros_like(a)
    fast = max(float(np.quantile(v, 0.95)), 1.0)
    x, t = v / fast, np.linspace(-1, 1, len(a))
    back = {s: _late(a, round(s / dt)) for s in (0.3, 0.8, 2.0)}
    push, brake = np.maximum(a, 0), np.minimum(a, 0)
    slow = {s: lfilter([dt / s], [1, dt / s - 1], push) for s in (1.0, 4.0)}
    heat = lfilter([dt / 30], [1, dt / 30 - 1], -brake * x)
    forces = [
        np.ones_like(a), a, a * np.abs(a), np.abs(a), push**2, brake**2, *back.values(), *slow.values(),
        np.maximum(push - 1, 0), np.minimum(brake + 1, 0), np.clip(a, -0.2, 0.2), np.clip(a, -0.05, 0.05),
        x, x**2, a * x, a * x**2, push * x, brake * x, brake * np.maximum(0, 1 - v / 5), np.maximum(0, 1 - v / 3),
        push * slow[1.0], push * slow[4.0], brake * heat, heat, t, t**2, a * t, brake * t,
        np.tanh(moved / 0.1), np.tanh(moved / 0.5), a * np.tanh(moved / 0.2), np.abs(moved), np.abs(u - a),
    ]  # fmt: skip
    faults = [a * x, a * t, np.abs(a), moved, _late(moved, round(0.5 / dt)), a * np.abs(a), x, t]
    readings = [a, np.abs(a), v * t, v * t**2, a * t, a * x, push, moved]
    out = []
    for force in forces:
        whole = {"accel": force, "speed": np.cumsum(force) * dt}
        out.append(np.stack([whole[w] for w in witnesses]))
    zero = np.zeros_like(a)
    if "accel" in witnesses:
        out += [np.stack([f if w == "accel" else zero for w in witnesses]) for f in faults]
    if "speed" in witnesses:
        out += [np.stack([r if w == "speed" else zero for w in witnesses]) for r in readings]
    return np.stack(out)


def _late(x: Float, rows: int) -> Float:
    return np.concatenate([np.full(rows, x[0]), x[: len(x) - rows]]) if rows else x


def _heldout(columns: Float, e: Float, fold: NDArray[np.int64]) -> float:
    """Nats a ridge regression on all columns gains on blocks it has not seen."""
    norms = np.sqrt((columns**2).sum((1, 2)))
    columns = columns[norms > 1e-9] / norms[norms > 1e-9][:, None, None]
    size = len(columns)
    gram, cross = np.zeros((_FOLDS, size, size)), np.zeros((_FOLDS, size))
    for k in range(_FOLDS):
        part = columns[:, :, fold == k].reshape(size, -1)
        gram[k] = part @ part.T
        cross[k] = part @ e[:, fold == k].ravel()
    best = 0.0
    for ridge in (0.03, 0.3, 3.0):
        gain = 0.0
        for k in range(_FOLDS):
            g, c = gram.sum(0) - gram[k], cross.sum(0) - cross[k]
            beta = np.linalg.solve(g + ridge * np.eye(size), c)
            gain += float(beta @ cross[k] - 0.5 * beta @ gram[k] @ beta)
        best = max(best, gain)
    return best


def _line(e: Float) -> float:
    """The strongest line's power over the mean, less what the strongest of so many has by chance [nats]."""
    power = np.abs(np.fft.rfft(e, axis=-1)) ** 2 / e.shape[-1]
    # against the level of the spectrum around
    level = np.stack([gaussian_filter1d(p, 40) for p in power])
    ratio = (power[:, 2:-1] / np.maximum(level[:, 2:-1], 0.2)).max(-1)
    return float(np.maximum(ratio - np.log(power.shape[-1]), 0).max())


def _memory(e: Float, fold: NDArray[np.int64], order: int = 12) -> float:
    """Nats an autoregression of each witness on both gains on blocks it has not seen."""
    _, rows = e.shape
    lagged = np.concatenate([[_late(x, k) for k in range(1, order + 1)] for x in e])
    lagged[:, :order] = 0.0
    scale = np.sqrt(rows)
    columns = lagged / scale
    gain = 0.0
    gram, cross = [], []
    for k in range(_FOLDS):
        part = columns[:, fold == k]
        gram.append(part @ part.T)
        cross.append(part @ e[:, fold == k].T)
    total, both = sum(gram), sum(cross)
    for k in range(_FOLDS):
        beta = np.linalg.solve(total - gram[k] + 0.1 * np.eye(len(columns)), both - cross[k])
        gain += float((beta * cross[k]).sum() - 0.5 * np.einsum("ij,ik,kj->", beta, gram[k], beta))
    return max(gain, 0.0)


def _bursts(e: Float, length: int = 40) -> float:
    """Nats gained by a variance of its own for each block of rows, shrunk to the mean, net of chance."""
    count, rows = e.shape
    whole = rows // length
    if whole < 4:
        return 0.0
    power = (e[:, : whole * length] ** 2).reshape(count, whole, length).mean(-1)
    power = power / power.mean(-1, keepdims=True)
    spread = power.var(-1) - 2 / length
    return float(np.maximum(0.25 * length * whole * np.maximum(spread, 0) - 3, 0).sum())


def _tails(e: Float) -> float:
    """Nats by which heavy tails describe single rows better, from the excess of the fourth moment."""
    z = np.clip(np.abs(e / e.std(-1, keepdims=True)), 0, 8)
    excess = (z**4).mean(-1) - 3
    return float(np.maximum(e.shape[-1] * excess**2 / 48 * np.sign(excess), 0).sum())
