"""Causes that chance decides and no rollout shows: heavy tails of the accelerometer, and lost messages.

Both leave their mark row by row at the log's own rate, on top of whatever else is amiss, so each is judged by the
likelihood ratio of single rows, given the errors of a rollout.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from avtorch.gap.innovations import Whitener
from avtorch.gap.onset import allowed

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Tails:
    """Heavy tails: `evidence` [nats] over a normal distribution, `fraction`, `scale` with sds of their links.

    `hit` (row,): rows more likely off than not. `ratios` (row,): log likelihood ratio of each row.
    """

    evidence: float
    fraction: float
    scale: float
    sds: tuple[float, float]
    hit: NDArray[np.bool_]
    ratios: Float = field(repr=False)
    onset: int | None = None


_TAIL_PRIOR = ((np.log(0.01), 1.5), (np.log(7.0), 0.4))


def tails(errors: Float, dt: float) -> Tails:
    """Outliers among accelerometer errors (row,), by their distance from the rows beside them.

    A row is held against the median of two before and two after it, which a single glitch does not move. The middle
    of these distances gives the size of the noise.
    """
    x = np.pad(errors, 2, mode="edge")
    beside = np.median(np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]), 0)
    away = errors - beside
    # a jump of the car shows in all rows of its moment, a glitch in one
    sd = max(1.4826 * float(np.median(np.abs(away - np.median(away)))), 1e-9)
    spread = np.abs(np.stack([x[:-4], x[1:-3], x[3:-1], x[4:]]) - beside)
    rough = np.sort(spread, 0)[1]  # of four neighbours, those nearest to their median
    away = away / np.maximum(sd, rough)

    def ratios(z: Float) -> Float:
        fraction, scale = (
            np.exp(_TAIL_PRIOR[0][0] + _TAIL_PRIOR[0][1] * z[0]),
            np.exp(_TAIL_PRIOR[1][0] + _TAIL_PRIOR[1][1] * z[1]),
        )
        fraction = min(fraction, 0.5)
        # in units of the distances' own sd, which is some 1.15 of the noise's
        wide = 1 + (scale / 1.15) ** 2
        gain = -0.5 * np.log(wide) + 0.5 * away**2 * (1 - 1 / wide)
        return np.log1p(fraction * np.expm1(np.minimum(gain, 500.0)))

    def cost(z: Float) -> float:
        return -float(ratios(z).sum()) + 0.5 * float(z @ z)

    best = min((minimize(cost, np.array([a, 0.0]), method="Nelder-Mead") for a in (-1.5, 0.5)), key=lambda m: m.fun)
    z = best.x
    per_row = ratios(z)
    hessian = _hessian(cost, z)
    evidence = -float(best.fun) - 0.5 * float(np.linalg.slogdet(hessian)[1])
    sds = np.sqrt(np.diag(np.linalg.inv(hessian)))
    fraction = float(min(np.exp(_TAIL_PRIOR[0][0] + _TAIL_PRIOR[0][1] * z[0]), 0.5))
    scale = float(np.exp(_TAIL_PRIOR[1][0] + _TAIL_PRIOR[1][1] * z[1]))
    wide = 1 + (scale / 1.15) ** 2
    hit = np.log(fraction) - np.log1p(-fraction) - 0.5 * np.log(wide) + 0.5 * away**2 * (1 - 1 / wide) > 0
    onset, gained = _onset(per_row, dt)
    return Tails(
        evidence=evidence + float(np.logaddexp(0.0, gained)) - float(np.log(2.0)),
        fraction=fraction,
        scale=scale,
        sds=(float(sds[0] * _TAIL_PRIOR[0][1]), float(sds[1] * _TAIL_PRIOR[1][1])),
        hit=hit & (np.abs(away) > 3.5),
        ratios=per_row,
        onset=onset if gained > 1 else None,
    )


def _hessian(cost, z: Float, h: float = 0.05) -> Float:  # type: ignore[no-untyped-def]
    size = len(z)
    out = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            a, b = np.eye(size)[i] * h, np.eye(size)[j] * h
            out[i, j] = (cost(z + a + b) - cost(z + a - b) - cost(z - a + b) + cost(z - a - b)) / (4 * h * h)
    out = 0.5 * (out + out.T)
    values, vectors = np.linalg.eigh(out)
    return (vectors * np.maximum(values, 1.0)) @ vectors.T


def _onset(ratios: Float, dt: float) -> tuple[int, float]:
    """Best onset row of per-row ratios, and what it gains net of not knowing it [nats]."""
    after = np.cumsum(ratios[::-1])[::-1]
    within = allowed(len(ratios), dt)
    best = within.start + int(np.argmax(after[within]))
    mass = np.exp(after[within] - after[best]).sum()
    return best, float(after[best] - after[0] + np.log(mass / len(ratios)))


@dataclass(frozen=True, eq=False)
class Losses:
    """Lost messages: `evidence` [nats] over none, `fraction` and the sd of its logit; `onset` row or None."""

    evidence: float
    fraction: float
    sd: float
    onset: int | None


_LONGEST_HOLD = 24


def losses(white: Whitener, errors: Float, command: Float, T_L: float, K_L: float) -> Losses:
    """Held commands, by matched filters at the rows where the command moves.

    A command lost `k` times in a row acts `k` rows late; what that does to both witnesses is known, so errors
    (witness, counted) are held against it. `command` (counted,), one message a row. Geometric numbers of losses are
    summed over.
    """
    record = white.record
    e = white(errors)[..., 0]
    dt = record.dt
    length = min(record.rows - 1, max(8, round(6 * T_L / dt) + 8))
    decay = np.exp(-dt / T_L)
    # one row of held command, per unit of (old - new): acceleration at the rows after it, and its integral
    pulse = np.zeros(record.rows)
    pulse[1:] = K_L * (1 - decay) * decay ** np.arange(record.rows - 1)
    gained = np.zeros(record.rows)
    gained[1] = K_L * (dt - T_L * (1 - decay))
    gained[2:] = gained[1] + T_L * K_L * (1 - decay) * (1 - decay ** np.arange(1, record.rows - 1))
    unit = np.stack([p for p, name in ((pulse, "accel"), (gained, "speed")) if name in record.witnesses])
    image = white.response(unit)[:, :length]
    jump = np.zeros(record.rows)
    same = np.diff(record.stretch) == 0
    jump[1:][same] = (command[:-1] - command[1:])[same]
    one = float((image**2).sum())
    strong = np.flatnonzero(np.abs(jump) ** 2 * one > 0.05)
    strong = strong[strong + length + _LONGEST_HOLD < record.rows]
    if not len(strong):
        return Losses(-2.0, 0.0, 1.0, None)
    shift = np.stack([_late(image, k, length + _LONGEST_HOLD) for k in range(_LONGEST_HOLD)])
    held = np.cumsum(shift, 0)  # (hold, witness, time): k + 1 rows late
    windows = np.lib.stride_tricks.sliding_window_view(e, length + _LONGEST_HOLD, axis=1)[:, strong]
    match = np.einsum("kwt,wst->sk", held, windows)
    square = np.einsum("kwt,kwt->k", held, held)
    gains = jump[strong][:, None] * match - 0.5 * jump[strong][:, None] ** 2 * square
    grid = np.concatenate([[0.0], np.linspace(0.004, 0.8, 120)])
    holds = np.arange(1, _LONGEST_HOLD + 1)
    with np.errstate(divide="ignore"):
        weights = np.log1p(-grid)[:, None] + holds * np.log(grid)[:, None]
    gains = np.minimum(gains, 200.0)
    rows = np.stack([np.log((1 - p) + np.exp(w + gains).sum(-1)) for p, w in zip(grid[1:], weights[1:], strict=True)])
    total = rows.sum(1)
    p = grid[1:]
    logit = np.log(p / (1 - p))
    prior = -0.5 * ((logit - np.log(0.08 / 0.92)) / 1.0) ** 2 - np.log(p * (1 - p)) - 0.5 * np.log(2 * np.pi)
    step = p[1] - p[0]
    top = float((total + prior).max())
    mass = np.exp(total + prior - top) * step
    evidence = top + float(np.log(mass.sum()))
    share = mass / mass.sum()
    mean = float(share @ p)
    best = int((total + prior).argmax())
    whole = np.zeros(record.rows)
    whole[strong] = rows[best]
    onset, more = _onset(whole, dt)
    sd = float(np.sqrt(share @ (logit - share @ logit) ** 2))
    return Losses(
        evidence + float(np.logaddexp(0.0, more) - np.log(2.0)), mean, max(sd, 1e-3), onset if more > 1 else None
    )


def _late(image: Float, rows: int, length: int) -> Float:
    out = np.zeros((len(image), length))
    out[:, rows : rows + image.shape[1]] = image
    return out
