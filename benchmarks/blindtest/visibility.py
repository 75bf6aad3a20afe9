r"""How visible a cause is in a log: rollout error relative to noise.

GLVD, refitted to the noise-free drive (`T_L`, `K_L`), is rolled out over the logged command: over the whole drive for
the acceleration, whose initial value is forgotten within a few lags; for the speed, from a new true start every 10 s
(and after every standstill). Let `e` be the remaining difference between log and rollout, without noise, and `n` the
process and sensor noise itself, both RMS over the rows that move (speed of 0.3 m/s or more). The visibility in one
channel is

    sqrt(n² + e²) / n

the rollout error of the refitted GLVD over the error that it would have without the cause; the visibility of a log is
the largest over its channels. For random effects (`gust`, `outliers`, `command_hold`), `e` is present too, but no
model's rollout removes it: for these the number measures the loss of predictive density, exp(loss of the mean log
density of a Gaussian error whose size is refitted), which is the same ratio.

Tiers: easy from 3 on, medium 1.6 to 3, hard 1.15 to 1.6, faint 1.02 to 1.15; below 1.02 there is no tier (None).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray
from benchmarks.blindtest.vehicle import Run

TIERS = {"easy": (3.0, np.inf), "medium": (1.6, 3.0), "hard": (1.15, 1.6), "faint": (1.02, 1.15)}
"""Bounds of visibility by tier: the rollout error of a model without the effect over that of one with it.

Example:
    >>> from benchmarks.blindtest import TIERS, tier_of
    >>> [tier_of(low) for low, _ in TIERS.values()] == list(TIERS)
    True
"""
HORIZON_S = 10.0
_SETTLED_S = 2.0  # start of a drive, in which no log identifies the actuator's initial state
_MOVING_MPS = 0.3
_LAGS_S = (0.02, 3.0)


def tier_of(visibility: float) -> str | None:
    """The tier a visibility falls in, None below 1.02.

    Example:
        >>> from benchmarks.blindtest import tier_of
        >>> [tier_of(visibility) for visibility in (1.01, 1.1, 2.0)]
        [None, 'faint', 'medium']
    """
    return next((name for name, (low, high) in TIERS.items() if low <= visibility < high), None)


def glvd_response(command: FloatArray, dt: float, T_L: float, K_L: float) -> FloatArray:
    """Acceleration (row,) of GLVD from rest under commands (row,) held for `dt` [s] each, zero-order hold, exact."""
    alpha = np.exp(-dt / T_L)
    answer = lfilter([0.0, -np.expm1(-dt / T_L) * K_L], [1.0, -alpha], command)
    return np.asarray(answer)


@dataclass(frozen=True)
class Sight:
    """Visibility in a drive. `accel`, `speed`: visibility by channel, 1 for a channel that is not logged; `T_L`, `K_L`:
    GLVD refitted to the drive.

    Example:
        >>> from benchmarks.blindtest import Sight
        >>> seen = Sight(accel=1.7, speed=1.2, T_L=0.6, K_L=1.0)
        >>> seen.most
        1.7
    """

    accel: float
    speed: float
    T_L: float
    K_L: float

    @property
    def most(self) -> float:
        """The larger of the two visibilities."""
        return max(self.accel, self.speed)

    @property
    def excess(self) -> float:
        """`e / n` of that channel, roughly proportional to the strength of the cause."""
        return float(np.sqrt(max(self.most**2 - 1.0, 0.0)))


def chunks(run: Run) -> Iterator[slice]:
    """Stretches of a drive over which the speed is rolled out: 2 to 10 s, moving throughout."""
    moving = run.true_speed >= _MOVING_MPS
    dt = float(run.time[1] - run.time[0])
    longest, shortest = round(HORIZON_S / dt), round(2.0 / dt)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(int), [0]])))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        for first in range(begin, end, longest):
            if min(first + longest, end) - first >= shortest:
                yield slice(first, min(first + longest, end))


class _Witnesses:
    """Errors of a rollout in both channels, from the exact start of every stretch."""

    def __init__(self, run: Run) -> None:
        self.moving = run.true_speed >= _MOVING_MPS
        inside = np.zeros(len(run.time), bool)
        first = np.arange(len(run.time))
        for part in chunks(run):
            inside[part] = True
            first[part] = part.start
        self.inside, self._first = inside, first

    def since_start(self, speed: FloatArray) -> FloatArray:
        """Change of a speed since the start of its stretch."""
        return speed - speed[self._first]

    def rms_accel(self, error: FloatArray) -> float:
        return float(np.sqrt(np.mean(error[self.moving] ** 2))) if self.moving.any() else 0.0

    def rms_speed(self, error: FloatArray) -> float:
        return float(np.sqrt(np.mean(error[self.inside] ** 2))) if self.inside.any() else 0.0


def exact_gain(command: FloatArray, dt: float, T_L: float) -> tuple[FloatArray, FloatArray]:
    """Acceleration and speed (row,) of GLVD with gain 1 from rest, both exact even where the command jumps."""
    accel = glvd_response(command, dt, T_L, 1.0)
    # dv = u dt - T (a_next - a): the integral of GLVD's equation over a row
    step = command * dt
    speed = np.concatenate([[0.0], np.cumsum(step)[:-1]]) - T_L * (accel - accel[0])
    return accel, speed


def sight(run: Run, signals: Sequence[str] = ("accel", "speed")) -> Sight:
    """Visibility in the channels `signals`: the difference of the drive from the best-fitting GLVD (module docstring).

    Example:
        >>> from benchmarks.blindtest import Car, DrivePlan, sight, simulate
        >>> drive, effect = DrivePlan("steps", seconds=20.0, rate_hz=50, seed=3), {"dead_time": {"delay_s": 0.5}}
        >>> run = simulate(Car(), drive.pilot(), seconds=20.0, rate_hz=50, effects=effect)
        >>> sight(run).accel > 1.15
        True
    """
    channel = _Witnesses(run)
    dt = float(run.time[1] - run.time[0])
    accel = run.accel - run.noise_accel
    speed = channel.since_start(run.speed - run.noise_speed - run.drift_speed)
    noise_a = max(channel.rms_accel(run.noise_accel), 1e-12)
    noise_v = max(channel.rms_speed(run.noise_speed + channel.since_start(run.drift_speed)), 1e-12)

    def fit(log_lag: float) -> tuple[float, float, float, float]:
        unit_a, unit_v = exact_gain(run.command, dt, float(np.exp(log_lag)))
        unit_v = channel.since_start(unit_v)
        weigh_a = ("accel" in signals) * channel.moving / noise_a**2
        weigh_v = ("speed" in signals) * channel.inside / noise_v**2
        top = float(np.sum(weigh_a * unit_a * accel) + np.sum(weigh_v * unit_v * speed))
        bottom = float(np.sum(weigh_a * unit_a**2) + np.sum(weigh_v * unit_v**2))
        gain = max(top / bottom, 0.0) if bottom > 0 else 1.0
        e_a = ("accel" in signals) * channel.rms_accel(accel - gain * unit_a) / noise_a
        e_v = ("speed" in signals) * channel.rms_speed(speed - gain * unit_v) / noise_v
        return e_a**2 + e_v**2, e_a, e_v, gain

    grid = np.linspace(np.log(_LAGS_S[0]), np.log(_LAGS_S[1]), 13)
    losses = [fit(float(x))[0] for x in grid]
    best = int(np.argmin(losses))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = minimize_scalar(lambda x: fit(float(x))[0], bounds=(low, high), method="bounded", options={"xatol": 1e-3})
    _, e_a, e_v, gain = fit(float(found.x))
    return Sight(float(np.hypot(1, e_a)), float(np.hypot(1, e_v)), float(np.exp(found.x)), gain)


@dataclass(frozen=True)
class Oracle:
    """Rollout errors (RMS) of one channel: of the refitted GLVD, and of a model that knows cause and parameters.

    `closed`: the share of the gap that knowledge of the cause closes; None where there is no gap (`before` within 10 %
    of `floor`).

    Example:
        >>> from benchmarks.blindtest import Oracle
        >>> oracle = Oracle(before=0.5, after=0.2, floor=0.1)
        >>> round(oracle.closed, 2)  # (0.5 - 0.2) of (0.5 - 0.1)
        0.75
    """

    before: float
    after: float
    floor: float

    @property
    def closed(self) -> float | None:
        if self.before <= 1.1 * self.floor:
            return None
        return (self.before - self.after) / (self.before - self.floor)


def oracles(run: Run, fitted: Sight, *, predictable: bool) -> dict[str, Oracle]:
    """`rollout_rmse_accel` [m/s²] and `rollout_rmse_speed` [m/s], over 10 s from a measured value, by metric.

    Over moving rows, from 2 s on. `predictable`: False where the response to the command is random (lost messages), so
    that knowing the cause improves no rollout. Gusts and outliers count towards the floor, as their contribution to the
    log is known.
    """
    dt = float(run.time[1] - run.time[0])
    rows = (run.true_speed >= _MOVING_MPS) & (run.time >= run.time[0] + _SETTLED_S)
    unit_a, unit_v = exact_gain(run.command, dt, fitted.T_L)
    # the error of an initial acceleration decays with the lag
    keeps = float(np.exp(-dt / fitted.T_L))
    before_a = _from_all_starts(run.accel - fitted.K_L * unit_a, rows, dt, keeps)
    before_v = _from_all_starts(run.speed - fitted.K_L * unit_v, rows, dt)
    if not predictable:
        return {
            "rollout_rmse_accel": Oracle(before_a, before_a, before_a),
            "rollout_rmse_speed": Oracle(before_v, before_v, before_v),
        }
    floor_a = _from_all_starts(run.noise_accel + run.chance_accel + run.felt_accel, rows, dt, keeps)
    floor_v = _from_all_starts(run.noise_speed + run.drift_speed + run.chance_speed, rows, dt)
    return {
        "rollout_rmse_accel": Oracle(before_a, floor_a, floor_a),
        "rollout_rmse_speed": Oracle(before_v, floor_v, floor_v),
    }


def _from_all_starts(error: FloatArray, rows: BoolArray, dt: float, keeps: float = 1.0) -> float:
    """RMS of the error over rollouts of up to 10 s, one from a measured value at each of the `rows`; a share `keeps` of
    the initial error remains after each row.

    With rollouts one after another a minute would hold only six, and the noise of their initial speeds would dominate.
    """
    length, shortest = round(HORIZON_S / dt), round(2.0 / dt)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], rows.astype(int), [0]])))
    squares, count = 0.0, 0
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if end - begin >= shortest:
            e = error[begin:end]
            at = np.arange(len(e)) + 1
            starts = np.minimum(at, length)
            mean, square = (_faded(e**power, length, keeps**power) / starts for power in (1, 2))
            squares += float((e**2 - 2 * e * mean + square).sum())
            count += len(e)
    return float(np.sqrt(squares / count)) if count else 0.0


def _faded(x: FloatArray, length: int, keeps: float) -> FloatArray:
    """Sums over the last `length` rows, each weighted by `keeps` to the power of its age."""
    if keeps == 1.0:
        total = np.concatenate([[0.0], np.cumsum(x)])
        at = np.arange(len(x)) + 1
        return total[at] - total[np.maximum(at - length, 0)]
    felt = min(length, len(x), 1 + int(np.log(1e-9) / np.log(keeps)))
    return np.convolve(x, keeps ** np.arange(felt))[: len(x)]
