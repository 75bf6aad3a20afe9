"""What a rollout leaves over, made white: the steady innovations filter of one linear-Gaussian noise model.

The error of a rollout is what no deterministic response foretells,

    dw/dt = p + d            error of the speed
    p: white jerk noise through the actuator's lag, an Ornstein-Uhlenbeck process (sd, time constant)
    d: a slow coloured force, the nuisance of every candidate and the cause called `gust`, likewise
    accel measured = p + d + white,   speed measured = w + white

with the interval between rows integrated exactly. The Kalman gain settles within some rows, so errors (row,) of both
witnesses pass one recursive filter to become white, thousands of columns at once. The speed's offset at the start of
each stretch is unknown and projected out. Where rows come in groups, their means pass the filter, and what rows of a
group differ by is white already.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import lfilter

from avtorch.gap.record import Record

Float = NDArray[np.float64]

NAMES = ("process_sd", "process_time", "force_sd", "force_time", "accel_sd", "speed_sd")


@dataclass(frozen=True)
class NoiseModel:
    """`process_sd`, `force_sd`, `accel_sd` [m/s²], `speed_sd` [m/s] (white ones of a group's mean), times [s].

    `within`: standard deviations by witness of the rows within a group; None where no rows are grouped.
    """

    process_sd: float = 0.05
    process_time: float = 0.35
    force_sd: float = 0.01
    force_time: float = 3.0
    accel_sd: float = 0.05
    speed_sd: float = 0.02
    within: tuple[float, ...] | None = None

    def replaced(self, **values: float) -> NoiseModel:
        return replace(self, **values)


@dataclass(frozen=True, eq=False)
class Whitener:
    """The filter of `noise` for the rows of `record`."""

    record: Record
    noise: NoiseModel

    @cached_property
    def _filter(self) -> tuple[list[list[Float]], Float, Float, float]:
        """Numerators by (out, in), the denominator, the inverse Cholesky factor of S, log det S."""
        n, dt = self.noise, self.record.dt
        drift = np.array([[0, 1, 1], [0, -1 / n.process_time, 0], [0, 0, -1 / n.force_time]], float)
        spectrum = np.diag([0.0, 2 * n.process_sd**2 / n.process_time, 2 * n.force_sd**2 / n.force_time])
        # a hair of speed noise, or the error of the speed is known exactly
        spectrum[0, 0] = 1e-12
        van_loan = expm(np.block([[-drift, spectrum], [np.zeros((3, 3)), drift.T]]) * dt)
        move = van_loan[3:, 3:].T
        driven = move @ van_loan[:3, 3:]
        see = np.array([[0, 1, 1], [1, 0, 0]], float)
        white = np.array([n.accel_sd**2, n.speed_sd**2])
        use = [i for i, name in enumerate(("accel", "speed")) if name in self.record.witnesses]
        see, white = see[use], np.diag(white[use])
        keep = slice(0, 3) if 1 in use else slice(1, 3)
        move, driven, see = move[keep, keep], driven[keep, keep], see[:, keep]
        ahead = solve_discrete_are(move.T, see.T, 0.5 * (driven + driven.T), white)
        s = see @ ahead @ see.T + white
        gain = move @ ahead @ see.T @ np.linalg.inv(s)
        lower_inverse = np.linalg.inv(np.linalg.cholesky(s))
        inner = move - gain @ see
        size = len(move)
        bottom = np.real(np.poly(inner))
        # adj(zI - A) by the Faddeev-LeVerrier recursion
        m, terms = np.eye(size), [np.eye(size)]
        for k in range(1, size):
            m = inner @ m + bottom[k] * np.eye(size)
            terms.append(m)
        tops = []
        for i in range(len(use)):
            row = []
            for j in range(len(use)):
                lead = [0.0, *(-(see[i] @ t @ gain[:, j]) for t in terms)]
                row.append(np.array(lead) + (bottom if i == j else 0.0))
            tops.append(row)
        # white at once: mix the outputs
        mixed = [
            [np.sum([lower_inverse[o, i] * tops[i][j] for i in range(len(use))], 0) for j in range(len(use))]
            for o in range(len(use))
        ]
        return mixed, np.asarray(bottom, float), np.asarray(lower_inverse, float), float(np.linalg.slogdet(s)[1])

    def _filtered(self, errors: Float) -> Float:
        tops, bottom, _, _ = self._filter
        padded = self.record.padded(errors)
        out = np.empty((*errors.shape[:-1], errors.shape[-1]))
        for o in range(errors.shape[-2]):
            total = sum(
                np.asarray(lfilter(tops[o][i], bottom, padded[..., i, :], axis=-1)) for i in range(errors.shape[-2])
            )
            out[..., o, :] = total[..., self.record.target]  # type: ignore[index]
        return out

    def response(self, errors: Float) -> Float:
        """White image of errors (witness, time) at consecutive rows that begin with the first, offset and all."""
        tops, bottom, _, _ = self._filter
        count = len(errors)
        return np.stack(
            [sum(np.asarray(lfilter(tops[o][i], bottom, errors[i])) for i in range(count)) for o in range(count)]
        )

    @cached_property
    def _offset(self) -> tuple[Float, Float]:
        """White image of a unit offset of the speed from each stretch's start (witness, counted), and its square."""
        unit = np.zeros((len(self.record.witnesses), self.record.rows))
        unit[-1] = 1.0
        image = self._filtered(unit)
        return image, np.add.reduceat((image**2).sum(0), self.record.starts)

    def __call__(self, errors: Float) -> Float:
        """Errors (..., witness, counted, group) made white, of unit variance: (..., witness, counted, 1 + group).

        First the groups' means, then what their rows differ by; without the latter where `errors` come with group 1.
        """
        mean = errors.mean(-1) if errors.shape[-1] > 1 else errors[..., 0].copy()
        if "speed" in self.record.witnesses:
            starts = self.record.starts
            mean[..., -1, :] -= mean[..., -1, starts][..., self.record.stretch]
            e = self._filtered(mean)
            image, square = self._offset
            part = np.add.reduceat((e * image).sum(-2), starts, -1) / square
            e -= image * part[..., None, self.record.stretch]
        else:
            e = self._filtered(mean)
        if errors.shape[-1] == 1 or self.noise.within is None:
            return e[..., None]
        apart = errors - errors.mean(-1, keepdims=True)
        apart /= np.array(self.noise.within)[:, None, None]
        return np.concatenate([e[..., None], apart], -1)

    @property
    def constant(self) -> float:
        """The log likelihood's part that does not depend on the errors."""
        rows, count = self.record.rows, len(self.record.witnesses)
        value = -0.5 * rows * (self._filter[3] + count * np.log(2 * np.pi))
        if "speed" in self.record.witnesses:
            value -= 0.5 * float(np.log(self._offset[1]).sum())
        if self.noise.within is not None:
            more = rows * (self.record.group - 1)
            value -= more * sum(float(np.log(sd)) + 0.5 * np.log(2 * np.pi) for sd in self.noise.within)
        return value

    def log_likelihood(self, errors: Float) -> Float:
        """Of errors (..., witness, counted, group): (...)."""
        e = self(errors)
        return self.constant - 0.5 * (e**2).sum((-1, -2, -3))
