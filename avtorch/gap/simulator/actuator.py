"""The actuator between command and body: its response over a step in which its target and lag are held.

    first order     T a' + a = g                        (Eq. 1; g = K u)
    rate-limited    a' = (g - a) / T from -jerk fall to jerk
    second order    tau² a'' + T a' + a = g             (first order at tau = 0)

A step has one part, or two where a late command switches within it. Each part is integrated exactly, for the
acceleration, its integral and its double integral. The same formulas serve one step (...) and whole drives (..., time):
first and second order by scans, the rate limit row by row.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.simulator.recursion import scan, scan_pair
from avtorch.vehicle.glvd import motion_coefficients

_NO_LIMIT = 1e9  # [m/s³] replaces infinity, as infinity times a part of length 0 would be undefined


Limits = tuple[Tensor, Tensor]
"""Most that an acceleration rises, and falls [m/s³]."""


@dataclass(frozen=True)
class Substep:
    """Part of a step: `target` g [m/s²], `lag` T [s], `length` [s]; (...) or (..., time)."""

    target: Tensor
    lag: Tensor
    length: Tensor

    def rows(self, rows: slice) -> Substep:
        return Substep(*(x[..., rows] if x.dim() and x.shape[-1] > 1 else x for x in vars(self).values()))


@dataclass(frozen=True)
class ActuatorState:
    """`accel` [m/s²]; of second order also `swing` = tau² a' [m/s² s] and the slewed `target`."""

    accel: Tensor
    swing: Tensor | None = None
    target: Tensor | None = None


@dataclass(frozen=True)
class Actuator:
    """`tau` [s] None: first order. `jerk` [m/s³] None: no limit; behind a second order it slews the target. A falling
    acceleration changes `fall` times as fast at most."""

    tau: Tensor | None = None
    jerk: Tensor | None = None
    fall: Tensor | None = None

    @property
    def limits(self) -> Limits | None:
        """Of a rising and a falling acceleration."""
        return None if self.jerk is None else (self.jerk, self.jerk if self.fall is None else self.jerk * self.fall)

    def steady_state(self, accel: Tensor) -> ActuatorState:
        """The state at rest at `accel`."""
        if self.tau is None:
            return ActuatorState(accel)
        return ActuatorState(accel, torch.zeros_like(accel), accel)

    def step(self, state: ActuatorState, parts: list[Substep]) -> tuple[ActuatorState, Tensor, Tensor]:
        """State after a step, change of the speed [m/s], and change of the position besides `speed dt` [m]."""
        gained = moved = torch.zeros_like(state.accel)
        for part in parts:
            state, speed, place = self._part(state, part)
            moved = moved + gained * part.length + place
            gained = gained + speed
        return state, gained, moved

    def over(self, accel0: Tensor, parts: list[Substep]) -> tuple[Tensor, Tensor]:
        """Accelerations (..., time) from `accel0` (...), and the change of the speed in each step (..., time - 1).

        `parts` hold the targets of all rows (the last one's is not needed); in steady state before the first row.
        """
        steps = parts[0].target.shape[-1] - 1
        parts = [part.rows(slice(0, steps)) for part in parts]
        rows = self._rows(accel0, parts)
        swing, target = (None if x is None else x[..., :-1] for x in (rows.swing, rows.target))
        before = ActuatorState(rows.accel[..., :-1], swing, target)
        return rows.accel, self.step(before, parts)[1]

    def _rows(self, accel0: Tensor, parts: list[Substep]) -> ActuatorState:
        """The states (..., time) of all rows."""
        if self.tau is not None:
            return self._second_rows(accel0, parts)
        jerk = self.limits
        if jerk is None:
            alpha, beta = torch.ones(1, dtype=accel0.dtype), torch.zeros(())
            for part in parts:
                ratio = part.length / part.lag
                keep = torch.exp(-ratio)
                alpha, beta = alpha * keep, keep * beta - torch.expm1(-ratio) * part.target
            return ActuatorState(_joined(accel0, scan(alpha, beta, accel0)))
        rows = by_rows(accel0, parts, jerk)
        later = _linearised(lambda a, part: _limited(a, part, jerk)[:2], parts, accel0, rows)
        return ActuatorState(_joined(accel0, later))

    def _second_rows(self, accel0: Tensor, parts: list[Substep]) -> ActuatorState:
        assert self.tau is not None
        target, jerk = None, self.limits
        if jerk is not None:
            rows = by_rows(accel0, parts, jerk, slews=True)
            target = _joined(accel0, _linearised(lambda r, part: _slewed(r, part, jerk)[:2], parts, accel0, rows))
            at, means = target[..., :-1], []
            for part in parts:
                at, _, mean = _slewed(at, part, jerk)
                means.append(Substep(mean, part.lag, part.length))
            parts = means
        one, zero = torch.ones(1, dtype=accel0.dtype), torch.zeros(1, dtype=accel0.dtype)
        from_accel, from_swing, added = (one, zero), (zero, one), (zero, zero)  # over all parts of the step
        for part in parts:
            modes = modes_over(self.tau, part.lag, part.length)
            from_accel, from_swing = _moved(modes, from_accel), _moved(modes, from_swing)
            accel, swing = _moved(modes, added)
            added = accel + (1 - modes[0]) * part.target, swing - modes[2] * part.target
        matrix = from_accel[0], from_swing[0], from_accel[1], from_swing[1]
        rest = torch.zeros_like(accel0)
        a, swing = scan_pair(matrix, added, (accel0, rest))
        return ActuatorState(_joined(accel0, a), _joined(rest, swing), target)

    def _part(self, state: ActuatorState, part: Substep) -> tuple[ActuatorState, Tensor, Tensor]:
        g, T, h = part.target, part.lag, part.length
        jerk = self.limits
        if self.tau is None:
            if jerk is None:
                alpha, m1, m2 = motion_coefficients(T, h)
                d = state.accel - g
                return ActuatorState(g + alpha * d), h * g + m1 * d, 0.5 * h * h * g + m2 * d
            accel, _, speed, place = _limited(state.accel, part, jerk)
            return ActuatorState(accel), speed, place
        assert state.swing is not None
        slewed = state.target
        if jerk is not None:
            assert slewed is not None
            slewed, _, g = _slewed(slewed, part, jerk)
        m00, m01, m10, m11 = modes_over(self.tau, T, h)
        d, w = state.accel - g, state.swing
        accel, swing = g + m00 * d + m01 * w, m10 * d + m11 * w
        speed = g * h - T * (accel - state.accel) - (swing - w)
        place = 0.5 * g * h * h - T * (speed - state.accel * h)
        place = place - (self.tau * self.tau * (accel - state.accel) - w * h)
        return ActuatorState(accel, swing, slewed), speed, place


def _moved(matrix: tuple[Tensor, Tensor, Tensor, Tensor], x: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    m00, m01, m10, m11 = matrix
    return m00 * x[0] + m01 * x[1], m10 * x[0] + m11 * x[1]


def _joined(first: Tensor, later: Tensor) -> Tensor:
    return torch.cat([first.expand(later.shape[:-1])[..., None], later], -1)


def _limited(a: Tensor, part: Substep, jerk: Limits) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rate-limited part from `a`: acceleration after it, its derivative by `a`, change of the speed, and change of the
    position besides `speed length`."""
    d = part.target - a
    J = _limit(d, jerk)
    at_limit = torch.minimum((d.abs() / J - part.lag).clamp_min(0.0), part.length)  # before the exponential part
    cut = torch.sign(d) * J * at_limit
    rest, left = part.length - at_limit, d - cut
    lost, mean = torch.expm1(-rest / part.lag), a + 0.5 * cut
    place = at_limit * at_limit * (0.5 * a + cut / 6) + mean * at_limit * rest
    place = place + 0.5 * rest * rest * part.target - motion_coefficients(part.lag, rest)[2] * left
    speed = mean * at_limit + rest * part.target + part.lag * lost * left
    return part.target - left * (1 + lost), 1 + lost, speed, place


def _limit(d: Tensor, jerk: Limits) -> Tensor:
    return torch.where(d > 0, *jerk).clamp_max(_NO_LIMIT)


def _slewed(r: Tensor, part: Substep, jerk: Limits) -> tuple[Tensor, Tensor, Tensor]:
    """Target after a part, slewed from `r` at no more than `jerk`; its derivative by `r`; its mean over the part."""
    h, d = part.length, part.target - r
    J = _limit(d, jerk)
    moving = torch.minimum(d.abs() / J, h)
    after = r + torch.maximum(torch.minimum(d, J * h), -J * h)
    # the mean deficit from the target is a shrinking trapezium during the slew, plus the constant rest after it
    missed = moving * 0.5 * (d + part.target - after) + (h - moving) * (part.target - after)
    mean = part.target - torch.where(h > 0, missed / torch.where(h > 0, h, 1.0), 0.0)
    return after, (d.abs() > J * h).to(r.dtype), mean


def by_rows(start: Tensor, parts: Sequence[Substep], jerk: Limits, *, slews: bool = False) -> Tensor:
    """States (..., time) after each row, from `start` (...), without derivatives: a first-order lag which `jerk`
    limits; or with `slews` a target that moves to the given one no faster."""
    each = [[x.detach() for x in (p.target, p.lag, p.length)] for p in parts]
    limits = [x.detach().clamp_max(_NO_LIMIT) for x in jerk]
    of_limits = [(*x.shape[:-1], 1) for x in limits]
    shape = np.broadcast_shapes((*start.shape, 1), *of_limits, *(x.shape for p in each for x in p))

    def columns(x: Tensor, time: int) -> FloatArray:
        return x.expand(*shape[:-1], time).reshape(-1, time).numpy()

    rows = np.stack([[columns(x, shape[-1]) for x in p] for p in each])
    first = columns(start.detach()[..., None], 1)[:, 0]
    most = np.stack([columns(x, 1)[:, 0] for x in limits])
    return torch.from_numpy(_limited_rows(first, rows, most, slews)).reshape(shape)


@njit(cache=True, error_model="numpy")
def _limited_rows(
    start: FloatArray, parts: FloatArray, limit: FloatArray, slews: bool
) -> FloatArray:  # pragma: no cover - compiled
    """(column, time) of `parts` (part, 3, column, time): targets, lags and lengths."""
    _, _, columns, rows = parts.shape
    out = np.empty((columns, rows))
    for c in range(columns):
        state, rise, fall = start[c], limit[0, c], limit[1, c]
        for k in range(rows):
            for p in range(parts.shape[0]):
                g, T, h = parts[p, 0, c, k], parts[p, 1, c, k], parts[p, 2, c, k]
                d = g - state
                J = rise if d > 0 else fall
                if slews:
                    state += min(max(d, -J * h), J * h)
                else:  # at the limit while it binds, then exponential
                    at_limit = min(max(abs(d) / J - T, 0.0), h)
                    left = d - np.copysign(J * at_limit, d)
                    state = g - left * np.exp((at_limit - h) / T)
            out[c, k] = state
    return out


def _linearised(
    step: Callable[[Tensor, Substep], tuple[Tensor, Tensor]], parts: Sequence[Substep], start: Tensor, rows: Tensor
) -> Tensor:
    """`rows` (..., time) again, as a linear recursion by the slopes of `step(before, part) -> (after, slope)` at each:
    first derivatives flow to `start` and to what `step` depends on."""
    before = after = torch.cat([start.detach().expand(rows.shape[:-1])[..., None], rows[..., :-1]], -1)
    slope = torch.ones_like(before)
    for part in parts:
        after, own = step(after, part)
        slope = slope * own.detach()
    return scan(slope, after - slope * before, start)


def modes_over(tau: Tensor, T: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Transition matrix over `h` of `(a - g, tau² a')`; with its derivatives regular at tau = 0 and critical
    damping."""
    square = tau * tau
    bend = T * T - 4 * square
    # (difference of the poles times h / 2)², by its series where small
    small = bend.abs() * h * h < 4e-4 * square * square
    real, complex_ = (bend > 0) & ~small, (bend <= 0) & ~small
    root = torch.sqrt(torch.where(small, 1.0, bend.abs()))
    slow = torch.exp(-2 * h / (T + torch.where(real, root, 0.0)))
    safe = square.clamp_min(1e-12)
    fast = torch.exp(-h * (T + torch.where(real, root, 0.0)) / (2 * safe))
    envelope = torch.exp(-h * T / (2 * safe))
    angle = torch.where(complex_, h * root / (2 * safe), 0.0)
    x = torch.where(small, bend * h * h / (4 * safe * safe), 0.0)
    C = torch.where(
        real,
        0.5 * (slow + fast),
        envelope * torch.where(small, 1 + x / 2 + x * x / 24, torch.cos(angle)),
    )
    S = torch.where(
        real,
        (slow - fast) / root,
        envelope * torch.where(small, h / safe * (1 + x / 6 + x * x / 120), 2 * torch.sin(angle) / root),
    )
    half = 0.5 * T * S
    return C + half, S, -square * S, C - half
