"""What a rollout leaves over, made white: the steady innovations filter of one linear-Gaussian noise model.

The error of a rollout is what no deterministic response foretells,

    dw/dt = p + d            error of the speed
    p: white jerk noise through the actuator's lag, an Ornstein-Uhlenbeck process (sd, time constant)
    d: a slow coloured force, the nuisance of every candidate and the cause called `gust`, likewise
    accel measured = p + d + white,   speed measured = w + white

with the interval between rows integrated exactly. The Kalman gain settles within some rows, so errors (row,) of both
witnesses pass one recursive filter to become white, thousands of columns at once. The speed's offset at the start of
each stretch is unknown and projected out. Errors of groups' means pass the filter of the groups' interval, which is
good enough for a first look; every row passes the exact one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.signal import lfilter

from avtorch.gap.record import Record

Float = NDArray[np.float64]

_NO_LAG = 2e-3  # [s], of which no log tells

NAMES = ("process_sd", "process_time", "force_sd", "force_time", "accel_sd", "speed_sd")


@dataclass(frozen=True)
class NoiseModel:
    """`process_sd`, `force_sd`, `accel_sd` [m/s²], `speed_sd` [m/s] (white, of single rows), times [s].

    What the accelerometer makes of the car's random motion: `sensor_scale` [-] times it, late by a first-order
    `sensor_lag` [s].
    """

    process_sd: float = 0.05
    process_time: float = 0.35
    force_sd: float = 0.01
    force_time: float = 3.0
    accel_sd: float = 0.05
    speed_sd: float = 0.02
    sensor_scale: float = 1.0
    sensor_lag: float = 0.0

    def replaced(self, **values: float) -> NoiseModel:
        return replace(self, **values)

    def seen_through(self, values: Mapping[str, float]) -> NoiseModel:
        """With the accelerometer that a candidate's parameter `values`, by key, speak of."""
        lag = values.get("sensor_lag.lag_s", 0.0)
        return replace(
            self,
            sensor_scale=values.get("sensor_scale.scale", 1.0),
            sensor_lag=lag if lag > _NO_LAG else 0.0,
        )

    def of_means(self, group: int) -> NoiseModel:
        """Of the means of `group` rows."""
        size = float(np.sqrt(group))
        return replace(self, accel_sd=self.accel_sd / size, speed_sd=self.speed_sd / size)


Until = tuple[tuple[int, NoiseModel], ...]
"""Noise of earlier parts of a record, each up to a counted row, in order."""
Filter = tuple[list[list[Float]], Float, float]
"""Numerators by (out, in), the denominator, log det of the innovations' covariance."""


@dataclass(frozen=True, eq=False)
class Whitener:
    """The map from errors to white ones of unit variance, for one noise model. Linear in the errors.

    `until`: what else the noise was in earlier parts of the record, each up to a counted row, in order.
    """

    record: Record
    noise: NoiseModel
    until: Until = ()

    @classmethod
    def each(
        cls, record: Record, noises: Sequence[NoiseModel], until: Sequence[Until] | None = None, *, coarse: bool = False
    ) -> list[Self]:
        """Of several noise models, their filters designed together: some ten times as fast as one by one."""
        earlier = [()] * len(noises) if until is None else until
        made = [cls(record, noise, own) for noise, own in zip(noises, earlier, strict=True)]
        parts = zip(*([*(n for _, n in own), noise] for noise, own in zip(noises, earlier, strict=True)), strict=True)
        filters = [cls._made(record, part, coarse) for part in parts]
        for i, white in enumerate(made):
            white._filters[coarse and record.group > 1] = [f[i] for f in filters]
        return made

    @staticmethod
    def _made(record: Record, noises: Sequence[NoiseModel], coarse: bool) -> list[Filter]:
        group = record.group if coarse else 1
        dt = record.dt if coarse else record.dt / record.group
        return _designed([n.of_means(group) for n in noises], dt, record.witnesses)

    @cached_property
    def _filters(self) -> dict[bool, list[Filter]]:
        return {}

    def _parts(self, coarse: bool) -> list[tuple[Filter, slice]]:
        """Filters, and which of the counted rows each of them judges."""
        coarse = coarse and self.record.group > 1
        if coarse not in self._filters:
            noises = [*(n for _, n in self.until), self.noise]
            self._filters[coarse] = [self._made(self.record, [n], coarse)[0] for n in noises]
        rows = [0, *(row for row, _ in self.until), self.record.rows]
        return [(f, slice(*ends)) for f, ends in zip(self._filters[coarse], pairwise(rows), strict=True)]

    def _filtered(self, errors: Float) -> Float:
        """Errors (..., witness, counted, group) through the filter."""
        count, group = errors.shape[-3], errors.shape[-1]
        record = self.record
        padded = record.padded(errors)
        out = np.empty(errors.shape)
        for (tops, bottom, _), part in self._parts(group == 1):
            target = record.target[part]
            seen = padded[..., : (target[-1] + 1) * group]
            for o in range(count):
                total = sum(np.asarray(lfilter(tops[o][i], bottom, seen[..., i, :], axis=-1)) for i in range(count))
                rows = np.asarray(total).reshape(*total.shape[:-1], -1, group)  # type: ignore[union-attr]
                out[..., o, part, :] = rows[..., target, :]
        return out

    def turned(self, images: Float) -> Float:
        """The transpose of the map, of images (..., witness, counted, group): the filter run backward in time."""
        record, (count, group) = self.record, images.shape[-3::2]
        images = np.array(images)
        offset = "speed" in record.witnesses
        if offset:
            images = self._without_offset(images)
        total = np.zeros_like(images)
        for (tops, bottom, _), part in self._parts(group == 1):
            own = np.zeros_like(images)
            own[..., part, :] = images[..., part, :]
            back = record.padded(own)[..., ::-1]
            for i in range(count):
                through = [np.asarray(lfilter(tops[o][i], bottom, back[..., o, :], axis=-1)) for o in range(count)]
                rows = np.sum(through, 0)[..., ::-1].reshape(*back.shape[:-2], -1, group)
                total[..., i, :, :] += rows[..., record.target, :]
        if offset:  # each stretch's first speed was taken off all of its rows
            total[..., -1, record.starts, 0] -= np.add.reduceat(total[..., -1, :, :].sum(-1), record.starts, -1)
        return total

    def response(self, errors: Float) -> Float:
        """White image of errors (witness, time) at consecutive rows that begin with the first, offset and all."""
        tops, bottom, _ = self._parts(False)[-1][0]
        count = len(errors)
        return np.stack(
            [sum(np.asarray(lfilter(tops[o][i], bottom, errors[i])) for i in range(count)) for o in range(count)]
        )

    @cached_property
    def _offsets(self) -> dict[bool, tuple[Float, Float]]:
        return {}

    def _offset(self, coarse: bool) -> tuple[Float, Float]:
        """White image of a unit offset of the speed from each stretch's start (witness, counted, group), its square."""
        coarse = coarse and self.record.group > 1
        if coarse not in self._offsets:
            unit = np.zeros((len(self.record.witnesses), self.record.rows, 1 if coarse else self.record.group))
            unit[-1] = 1.0
            image = self._filtered(unit)
            self._offsets[coarse] = image, np.add.reduceat((image**2).sum((0, 2)), self.record.starts)
        return self._offsets[coarse]

    def _without_offset(self, e: Float) -> Float:
        image, square = self._offset(e.shape[-1] == 1)
        part = np.add.reduceat((e * image).sum((-3, -1)), self.record.starts, -1) / square
        return e - image * part[..., None, self.record.stretch, None]

    def __call__(self, errors: Float) -> Float:
        """Errors (..., witness, counted, group) made white, of unit variance, the same shape.

        Errors of groups' means come with group 1.
        """
        if "speed" not in self.record.witnesses:
            return self._filtered(errors)
        errors = errors.copy()
        errors[..., -1, :, :] -= errors[..., -1, self.record.starts, :1][..., self.record.stretch, :]
        return self._without_offset(self._filtered(errors))

    def constants(self, *, coarse: bool) -> Float:
        """Each row's part (counted,) of what the log likelihood has that does not depend on the errors."""
        record = self.record
        each, count = 1 if coarse else record.group, len(record.witnesses)
        out = np.empty(record.rows)
        for (_, _, size), part in self._parts(coarse):
            out[part] = -0.5 * each * (size + count * np.log(2 * np.pi))
        if "speed" in record.witnesses:
            out -= 0.5 * float(np.log(self._offset(coarse)[1]).sum()) / record.rows
        return out

    def constant_of(self, *, coarse: bool) -> float:
        """What the log likelihood has that does not depend on the errors."""
        return float(self.constants(coarse=coarse).sum())

    def log_likelihood(self, errors: Float) -> Float:
        """Of errors (..., witness, counted, group): (...)."""
        e = self(errors)
        return self.constant_of(coarse=errors.shape[-1] == 1) - 0.5 * (e**2).sum((-1, -2, -3))

    def row_likelihoods(self, errors: Float) -> Float:
        """Log likelihood (counted,) of each row of errors (witness, counted, group); sums to the whole."""
        return self.constants(coarse=errors.shape[-1] == 1) - 0.5 * (self(errors) ** 2).sum((0, 2))


def sensed(record: Record, noise: NoiseModel, motion: Float) -> Float:
    """What the witnesses show of a motion (..., witness, counted, group), the accelerometer with its scale and lag."""
    if "accel" not in record.witnesses or (noise.sensor_scale == 1.0 and noise.sensor_lag == 0.0):
        return motion
    motion = motion.copy()
    accel = noise.sensor_scale * motion[..., 0, :, :]
    if noise.sensor_lag > 0:
        flat = accel.reshape(*accel.shape[:-2], -1)
        lost = -np.expm1(-record.dt / accel.shape[-1] / noise.sensor_lag)
        accel = np.asarray(lfilter([lost], [1, lost - 1], flat, axis=-1)).reshape(accel.shape)
    motion[..., 0, :, :] = accel
    return motion


def _designed(noises: Sequence[NoiseModel], dt: float, witnesses: tuple[str, ...]) -> list[Filter]:
    """The steady Kalman filter from errors to innovations of unit covariance, for each noise model.

    The models have a sensor's lag all of them, or none.
    """
    pairs = [_motion(n, dt) for n in noises]
    move, driven = np.stack([p[0] for p in pairs]), np.stack([p[1] for p in pairs])
    use = [i for i, name in enumerate(("accel", "speed")) if name in witnesses]
    keep = slice(0 if 1 in use else 1, move.shape[-1])
    felt = [0, 0, 0, 1] if move.shape[-1] == 4 else [0, 1, 1]
    seen = np.array([[felt, [1, *[0] * (len(felt) - 1)]]] * len(noises), float)
    seen[:, 0] *= np.array([n.sensor_scale for n in noises])[:, None]
    see = seen[:, use][..., keep]
    white = np.stack([np.diag(np.array([n.accel_sd**2, n.speed_sd**2])[use]) for n in noises])
    move, driven = move[:, keep, keep], driven[:, keep, keep]
    ahead = _steady(move, see, driven, white)
    s = see @ ahead @ see.mT + white
    gain = move @ ahead @ see.mT @ np.linalg.inv(s)
    mix = np.linalg.inv(np.linalg.cholesky(s))
    inner = move - gain @ see
    # adj(z - inner) and det(z - inner) by the Faddeev-LeVerrier recursion
    size, count = inner.shape[-1], len(use)
    m, terms = np.broadcast_to(np.eye(size), inner.shape), []
    bottom = np.ones((len(noises), size + 1))
    for k in range(1, size + 1):
        terms.append(m)
        m = inner @ m
        bottom[:, k] = -np.trace(m, axis1=-2, axis2=-1) / k
        m = m + bottom[:, k, None, None] * np.eye(size)
    # innovations: errors less what the filter expects, 1 - see adj gain / det
    tops = np.zeros((len(noises), count, count, size + 1))
    for k, term in enumerate(terms):
        tops[..., k + 1] = -(see @ term @ gain)
    tops += np.eye(count)[:, :, None] * bottom[:, None, None, :]
    mixed = np.einsum("noi,nijk->nojk", mix, tops)
    sizes = np.linalg.slogdet(s)[1]
    return [([list(row) for row in mixed[i]], bottom[i], float(sizes[i])) for i in range(len(noises))]


def _motion(n: NoiseModel, dt: float) -> tuple[Float, Float]:
    """State (error of the speed, p, d) over `dt`: its transition and the covariance that is added, both exact.

    Two Ornstein-Uhlenbeck processes and the integral of their sum. Behind a late sensor its reading is a fourth state.
    """
    if n.sensor_lag > 0:
        return _late_motion(n, dt)
    move, driven = np.eye(3), np.zeros((3, 3))
    # a hair of speed noise, or the error of the speed is known exactly
    driven[0, 0] = 1e-12 * dt
    for i, sd, time in ((1, n.process_sd, n.process_time), (2, n.force_sd, n.force_time)):
        lost = -np.expm1(-dt / time)
        move[i, i], move[0, i] = 1 - lost, time * lost
        driven[i, i] = sd**2 * lost * (2 - lost)
        driven[0, i] = driven[i, 0] = sd**2 * time * lost**2
        driven[0, 0] += sd**2 * time**2 * _integral(dt / time)
    return move, driven


def _late_motion(n: NoiseModel, dt: float) -> tuple[Float, Float]:
    """By van Loan's matrix exponential."""
    drift = np.diag([0.0, -1 / n.process_time, -1 / n.force_time, -1 / n.sensor_lag])
    drift[0, 1:3], drift[3, 1:3] = 1.0, 1 / n.sensor_lag
    spectrum = np.diag([1e-12, 2 * n.process_sd**2 / n.process_time, 2 * n.force_sd**2 / n.force_time, 0.0])
    # in halves of a step short enough for the growing half of the matrix, then doubled
    halves = max(0, int(np.ceil(np.log2(dt / n.sensor_lag))) + 1)
    step = np.asarray(expm(np.block([[-drift, spectrum], [np.zeros((4, 4)), drift.T]]) * dt / 2**halves), float)
    move = step[4:, 4:].T
    driven = move @ step[:4, 4:]
    for _ in range(halves):
        driven = driven + move @ driven @ move.T
        move = move @ move
    return np.asarray(move, float), np.asarray(0.5 * (driven + driven.T), float)


def _integral(x: float) -> float:
    """Variance of the integral of a unit process over `x` of its times: 2 x - 3 + 4 exp(-x) - exp(-2 x)."""
    if x < 0.02:  # the series, where the terms above cancel
        return x**3 * (2 / 3 - x / 2 + 7 * x**2 / 30 - x**3 / 12)
    return 2 * x - 3 + 4 * float(np.exp(-x)) - float(np.exp(-2 * x))


def _steady(move: Float, see: Float, driven: Float, white: Float) -> Float:
    """Covariances (model, state, state) ahead of a reading, once they have settled: the Riccati equation by doubling.

    Structure-preserving doubling (Anderson 1978): each round covers twice as many rows as the last.
    """
    a, g, h = move.mT, see.mT @ np.linalg.solve(white, see), driven
    one = np.eye(move.shape[-1])
    for _ in range(60):
        inside = np.linalg.inv(one + g @ h)
        left, more = a @ inside, a.mT @ h @ inside @ a
        g = g + left @ g @ a.mT
        a = left @ a
        h = h + more
        if bool((np.abs(more).max((-1, -2)) <= 1e-14 * np.abs(h).max((-1, -2))).all()):
            break
    return np.asarray(0.5 * (h + h.mT), float)
