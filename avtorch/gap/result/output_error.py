r"""Free runs of a car with a force table and a resistance, and their slopes by what is at the tables' knots.

    x = lag_T[F(u, v) + k u],    dv/dt = a + x + R(v)

a is what the named car does with the commands, u the commands as they arrive, v the speed of the run itself. F and R
are linear between knots, so one recursion a knot is the exact derivative of a run, whatever covariance the knots have.
Where u is the speed that a controller misses, the loop is closed: a run that is faster misses less, a dead time later.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

from avtorch.arrays import BoolArray, FloatArray, IntArray

STEP_S = 0.1
"""Step of the runs [s]: a command is averaged over it, and lags are exact."""
SETTLED_S = 1.5  # of a stretch, before a run begins: the lag has forgotten where it started
_SHORTEST_S = 1.5  # run
_EVERY_S = 1.0  # between begins
_RECORD_S = 0.2  # between errors that count
_MOST_RUNS = 400
_FASTEST_MPS = 200.0


class Coefficients(NamedTuple):
    """Forces [m/s²] at knots: `table` (u, v) and `curve` (v,); `gain` [-] beyond the named car's."""

    table: FloatArray
    curve: FloatArray
    gain: float

    @classmethod
    def of(cls, vector: FloatArray, shape: tuple[int, int]) -> Coefficients:
        """From (coefficient,), the table's rows first."""
        nodes = shape[0] * shape[1]
        return cls(vector[:nodes].reshape(shape), vector[nodes:-1], float(vector[-1]))


class Rows(NamedTuple):
    """Rows of all stretches, `dt` [s] apart, about `STEP_S`.

    (row,): `command` [m/s²] as it arrives, mean over the step; `speed` [m/s]; `source`, the row of the drives; `starts`
    of stretches. `knots_u`, `knots_v`: where the tables are told. `loop_s`: None, or the dead time [s] after which
    `command` is the speed that is missing [m/s]; the gain then acts on `feed` (row,), by default on the command.
    """

    dt: float
    command: FloatArray
    speed: FloatArray
    source: IntArray
    starts: BoolArray
    knots_u: FloatArray
    knots_v: FloatArray
    loop_s: float | None = None
    feed: FloatArray | None = None

    @property
    def between(self) -> int:
        """Rows between errors that count."""
        return max(1, round(_RECORD_S / self.dt))

    @property
    def shape(self) -> tuple[int, int]:
        """Of the table."""
        return len(self.knots_u), len(self.knots_v)


@dataclass(frozen=True, eq=False)
class Runs:
    """Free runs over `rows` from row `first` (run,) to before row `end` (run,); errors count from row `counts` on."""

    rows: Rows
    first: IntArray = field(repr=False)
    end: IntArray = field(repr=False)
    counts: IntArray = field(repr=False)

    @classmethod
    def of(cls, rows: Rows, edges: IntArray | None, longest_s: float, settled_s: float) -> Runs:
        """Begun every second of each stretch, or more rarely in long drives; none goes beyond one of `edges` (edge,),
        rows that are the stretches' own starts and may be more. `longest_s`, `settled_s`: of a run, and of a stretch
        before the first one [s]."""
        dt, count = rows.dt, len(rows.speed)
        begins = np.append(np.flatnonzero(rows.starts), count)
        every = max(1, round(_EVERY_S / dt), int(np.ceil(count / _MOST_RUNS)))
        shortest, settled = max(2, round(_SHORTEST_S / dt)), round(settled_s / dt)
        first, end = [], []
        for i, j in itertools.pairwise(begins if edges is None else edges):
            own = np.arange(i + settled if rows.starts[i] else i, j - shortest, every)
            first.append(own)
            end.append(np.minimum(own + round(longest_s / dt), j))
        a = np.concatenate(first)
        return cls(rows, a, np.concatenate(end), a)

    @classmethod
    def over_blocks(cls, rows: Rows, edges: IntArray, before_s: float, settled_s: float) -> Runs:
        """One for each block between `edges` (edge,), begun `before_s` [s] earlier where its stretch allows: how it
        began has faded when it counts."""
        i, j = edges[:-1], edges[1:]
        opens = np.flatnonzero(rows.starts)
        stretch = opens[np.searchsorted(opens, i, side="right") - 1] + round(settled_s / rows.dt)
        first = np.maximum(i - round(before_s / rows.dt), stretch)
        counts = np.maximum(i, first)
        kept = j - counts > max(2, round(_SHORTEST_S / rows.dt))
        return cls(rows, first[kept], j[kept], counts[kept])

    @cached_property
    def of_run(self) -> IntArray:
        """The run of each error (error,)."""
        return np.repeat(np.arange(len(self.first)), (self.end - self.counts - 1) // self.rows.between)

    def drive(self, named: FloatArray, lag: float, at: Coefficients) -> tuple[FloatArray, FloatArray]:
        """Errors (error,) [m/s] of all runs and their derivatives (error, coefficient). `named` (row,) [m/s²]: what the
        car does without free forms, mean over the step."""
        rows = self.rows
        return _drive(
            *(self.first, self.end, self.counts, rows.between, rows.dt, lag),
            *(named, rows.command, rows.speed, rows.starts),
            *(rows.knots_u, rows.knots_v, np.ascontiguousarray(at.table), at.curve, at.gain),
            rows.command if rows.feed is None else rows.feed,
            *(-1.0 if rows.loop_s is None else rows.loop_s / rows.dt, len(self.of_run)),
        )


@njit(cache=True, error_model="numpy")
def _below(x: float, knots: FloatArray) -> tuple[int, float, float]:  # pragma: no cover - compiled
    """The knot below, the share of the way to the next one, and its slope by `x`."""
    last = len(knots) - 2
    if x <= knots[0]:
        return 0, 0.0, 0.0
    if x >= knots[last + 1]:
        return last, 1.0, 0.0
    i = 0
    while i < last and x > knots[i + 1]:
        i += 1
    wide = knots[i + 1] - knots[i]
    return i, (x - knots[i]) / wide, 1.0 / wide


@njit(cache=True, fastmath=True, error_model="numpy")
def _drive(  # pragma: no cover - compiled
    first: IntArray,
    end: IntArray,
    counts: IntArray,
    record: int,
    dt: float,
    lag: float,
    named: FloatArray,
    command: FloatArray,
    speed: FloatArray,
    starts: BoolArray,
    knots_u: FloatArray,
    knots_v: FloatArray,
    table: FloatArray,
    curve: FloatArray,
    gain: float,
    feed: FloatArray,
    late: float,
    errors: int,
) -> tuple[FloatArray, FloatArray]:
    nv, nodes = len(knots_v), len(knots_u) * len(knots_v)
    size = nodes + nv + 1
    err, J = np.empty(errors), np.empty((errors, size))
    keep = np.exp(-dt / lag)
    begun = np.zeros((len(first), size))  # what is in the lag where a run begins
    begun_x = np.zeros(len(first))
    S, s, at = np.zeros(size), 0.0, 0
    for i in range(len(speed)):  # along what was measured
        a, p, _ = _below(command[i], knots_u)
        b, q, _ = _below(speed[i], knots_v)
        w00, w01, w10, w11 = (1 - p) * (1 - q), (1 - p) * q, p * (1 - q), p * q
        n = a * nv + b
        F = w00 * table[a, b] + w01 * table[a, b + 1] + w10 * table[a + 1, b] + w11 * table[a + 1, b + 1]
        F += gain * feed[i]
        k = 0.0 if starts[i] else keep
        while at < len(first) and first[at] == i:
            begun_x[at] = s
            begun[at] = S
            at += 1
        S *= k
        s = k * s + (1 - k) * F
        S[n] += (1 - k) * w00
        S[n + 1] += (1 - k) * w01
        S[n + nv] += (1 - k) * w10
        S[n + nv + 1] += (1 - k) * w11
        S[size - 1] += (1 - k) * feed[i]
    row = 0
    dx, dv, du = np.zeros(size), np.zeros(size), np.zeros(size)
    whole = int(np.floor(late - 0.5))  # a command is the mean over a step, whose middle is half a step on
    part = late - 0.5 - whole
    off, by_off = np.zeros(1), np.zeros((1, 1))  # how much faster a run of a loop is than what was measured
    if late >= 0.0:
        longest = 1 + (end - first).max()
        off, by_off = np.zeros(longest), np.zeros((longest, size))
    for r in range(len(first)):
        v, x, since = float(speed[first[r]]), float(begun_x[r]), 0
        dx[:] = begun[r]
        dv[:] = 0.0
        for i in range(first[r], end[r] - 1):
            u = command[i]
            if late >= 0.0:
                now = i - first[r]
                off[now], by_off[now] = v - speed[i], dv
                du[:] = 0.0
                # what is not yet known goes on as by the last step
                near, more = (now - whole, 1.0 - part) if whole >= 0 else (now, 2.0 - part)
                for k, share in ((near, more), (near - 1, 1.0 - more)):
                    if k >= 0:
                        u -= share * off[k]
                        for j in range(size):
                            du[j] -= share * by_off[k, j]
            a, p, by_u = _below(u, knots_u)
            b, q, by = _below(v, knots_v)
            n = a * nv + b
            low = (1 - p) * table[a, b] + p * table[a + 1, b]
            high = (1 - p) * table[a, b + 1] + p * table[a + 1, b + 1]
            F = low + q * (high - low) + gain * feed[i]
            after = keep * x + (1 - keep) * F
            R = curve[b] + q * (curve[b + 1] - curve[b])
            # the lagged force gains F dt - lag (after - x)
            kept, new = lag * (1 - keep), dt - lag * (1 - keep)
            bend = new * (high - low) * by
            fall = dt * (curve[b + 1] - curve[b]) * by
            force = (1 - keep) * (high - low) * by
            for j in range(size):
                d = dv[j]
                dv[j] = d * (1.0 + bend + fall) + kept * dx[j]
                dx[j] = keep * dx[j] + force * d
            if late >= 0.0:
                left = (1 - q) * table[a, b] + q * table[a, b + 1]
                steep = by_u * ((1 - q) * table[a + 1, b] + q * table[a + 1, b + 1] - left)
                for j in range(size):
                    dv[j] += new * steep * du[j]
                    dx[j] += (1 - keep) * steep * du[j]
            for j, w in ((n, (1 - p) * (1 - q)), (n + 1, (1 - p) * q), (n + nv, p * (1 - q)), (n + nv + 1, p * q)):
                dv[j] += new * w
                dx[j] += (1 - keep) * w
            dv[size - 1] += new * feed[i]
            dx[size - 1] += (1 - keep) * feed[i]
            dv[nodes + b] += dt * (1 - q)
            dv[nodes + b + 1] += dt * q
            v += dt * (named[i] + R) + F * dt - lag * (after - x)
            x = after
            if v < 0.0:
                v = 0.0
                dv[:] = 0.0
            v = min(v, _FASTEST_MPS)
            since += i >= counts[r]
            if since == record:
                since = 0
                err[row], J[row] = v - speed[i + 1], dv
                row += 1
    return err, J
