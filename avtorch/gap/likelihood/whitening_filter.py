"""Whitening filter for rollout residuals: the steady-state innovations filter of one noise model.

Errors (row,) of both channels pass one recursive filter, thousands of columns at once. The speed's offset at the start
of each stretch is unknown and projected out. Errors averaged over groups pass the filter of the groups' interval, which
is accurate enough for screening; single rows pass the exact filter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import Float, FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.grade_marginal import GradeMarginal
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.likelihood.steady_kalman import Filter, designed

Until = tuple[tuple[int, NoiseModel], ...]
"""Noise models of earlier parts of a record, each up to a counted row, in order."""


@dataclass(frozen=True, eq=False)
class WhiteningFilter:
    """The linear map from errors to whitened errors of unit variance, for one noise model.

    `until`: noise models of earlier parts of the record, each up to a counted row, in order.
    """

    record: Record
    noise: NoiseModel
    until: Until = ()

    @classmethod
    def each(
        cls, record: Record, noises: Sequence[NoiseModel], until: Sequence[Until] | None = None, *, coarse: bool = False
    ) -> list[Self]:
        """One filter for each noise model; designing them together is about ten times as fast as one by one."""
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
        return designed([n.of_means(group) for n in noises], dt, record.channels)

    @cached_property
    def _filters(self) -> dict[bool, list[Filter]]:
        return {}

    def _parts(self, coarse: bool) -> list[tuple[Filter, slice]]:
        """Filters, and the slice of counted rows to which each applies."""
        coarse = coarse and self.record.group > 1
        if coarse not in self._filters:
            noises = [*(n for _, n in self.until), self.noise]
            self._filters[coarse] = [self._made(self.record, [n], coarse)[0] for n in noises]
        rows = [0, *(row for row, _ in self.until), self.record.rows]
        return [(f, slice(*ends)) for f, ends in zip(self._filters[coarse], pairwise(rows), strict=True)]

    def _filtered(
        self, errors: Float[FloatArray, "*column channel counted group"]
    ) -> Float[FloatArray, "*column channel counted group"]:
        """Errors (..., channel, counted, group) through the filter, each stretch from rest."""
        group = errors.shape[-1]
        out = np.empty(errors.shape)
        for (whiten, _), part in self._parts(group == 1):
            for stretch in self._stretches:
                # a later filter has seen the whole stretch
                rows, kept = slice(stretch.start, min(stretch.stop, part.stop)), max(stretch.start, part.start)
                if kept >= rows.stop:
                    continue
                white = whiten(errors[..., rows, :].reshape(*errors.shape[:-2], -1))
                out[..., kept : rows.stop, :] = white.reshape(*white.shape[:-1], -1, group)[..., kept - rows.start :, :]
        return out

    def transpose(
        self, images: Float[FloatArray, "*column channel counted group"]
    ) -> Float[FloatArray, "*column channel counted group"]:
        """Transpose of the map, for images (..., channel, counted, group): the filter run backward in time."""
        record, group = self.record, images.shape[-1]
        images = np.array(images, order="C")
        if "speed" in record.channels:
            self._without_offset(images)
        total = np.zeros_like(images)
        for (whiten, _), part in self._parts(group == 1):
            for stretch in self._stretches:
                rows, kept = slice(stretch.start, min(stretch.stop, part.stop)), max(stretch.start, part.start)
                if kept >= rows.stop:
                    continue
                own = np.array(images[..., rows, :])
                own[..., : kept - rows.start, :] = 0.0
                back = whiten.transpose(own.reshape(*own.shape[:-2], -1)[..., ::-1])[..., ::-1]
                total[..., rows, :] += back.reshape(*back.shape[:-1], -1, group)
        return total

    def response(self, errors: Float[FloatArray, "channel time"]) -> Float[FloatArray, "channel time"]:
        """Whitened image of errors (channel, time) at consecutive rows from the first on, with the offset included."""
        return self._parts(False)[-1][0][0](errors)

    @cached_property
    def _offsets(self) -> dict[bool, tuple[FloatArray, FloatArray]]:
        return {}

    def _offset(self, coarse: bool) -> tuple[FloatArray, FloatArray]:
        """Whitened image (channel, counted, group) of a unit speed offset of each stretch, and its squared norm."""
        coarse = coarse and self.record.group > 1
        if coarse not in self._offsets:
            unit = np.zeros((len(self.record.channels), self.record.rows, 1 if coarse else self.record.group))
            unit[-1] = 1.0
            image = self._filtered(unit)
            self._offsets[coarse] = image, np.add.reduceat((image**2).sum((0, 2)), self.record.starts)
        return self._offsets[coarse]

    def _without_offset(
        self, e: Float[FloatArray, "*column channel counted group"]
    ) -> Float[FloatArray, "*column channel counted group"]:
        """`e`, changed in place."""
        image, square = self._offset(e.shape[-1] == 1)
        for column in e.reshape(-1, *e.shape[-3:]):
            for number, stretch in enumerate(self._stretches):
                rows, own = column[:, stretch], image[:, stretch]
                rows -= np.vdot(rows, own) / square[number] * own
        return e

    @property
    def _stretches(self) -> list[slice]:
        starts = self.record.starts.tolist()
        return [slice(*ends) for ends in pairwise([*starts, self.record.rows])]

    def __call__(
        self, errors: Float[FloatArray, "*column channel counted group"]
    ) -> Float[FloatArray, "*column channel counted group"]:
        """Whitened errors of unit variance, in the shape (..., channel, counted, group) of `errors`.

        Errors averaged over groups have group size 1.
        """
        white = self._filtered(errors)
        return self._without_offset(white) if "speed" in self.record.channels else white

    @cached_property
    def _last_grade(self) -> list[tuple[FloatArray, int | None, GradeMarginal]]:
        return []

    def grade_marginal(
        self, columns: Float[FloatArray, "knot channel counted group"], onset: int | None
    ) -> GradeMarginal:
        """Of a slope that does `columns` per unit of each coefficient, from `onset` on. The last one is kept."""
        for kept, since, marginal in self._last_grade:
            if kept is columns and since == onset:
                return marginal
        felt = sensed(self.record, self.noise, acting(self.record, columns, onset))
        made = GradeMarginal.of(self(felt).reshape(len(columns), -1))
        self._last_grade[:] = [(columns, onset, made)]
        return made

    def constants(self, *, coarse: bool) -> Float[FloatArray, " counted"]:
        """Each row's term (counted,) of the log likelihood that does not depend on the errors."""
        record = self.record
        each, count = 1 if coarse else record.group, len(record.channels)
        out = np.empty(record.rows)
        for (_, size), part in self._parts(coarse):
            out[part] = -0.5 * each * (size + count * np.log(2 * np.pi))
        if "speed" in record.channels:
            out -= 0.5 * float(np.log(self._offset(coarse)[1]).sum()) / record.rows
        return out

    def constant_of(self, *, coarse: bool) -> float:
        """The term of the log likelihood that does not depend on the errors."""
        return float(self.constants(coarse=coarse).sum())

    def log_likelihood(
        self, errors: Float[FloatArray, "*column channel counted group"]
    ) -> Float[FloatArray, "*column"]:
        """Log likelihood (...) of errors (..., channel, counted, group)."""
        e = self(errors)
        return np.asarray(self.constant_of(coarse=errors.shape[-1] == 1) - 0.5 * (e**2).sum((-1, -2, -3)))

    def row_likelihoods(self, errors: Float[FloatArray, "channel counted group"]) -> Float[FloatArray, " counted"]:
        """Log likelihood (counted,) of each row of errors (channel, counted, group); the rows sum to the total."""
        return self.constants(coarse=errors.shape[-1] == 1) - 0.5 * (self(errors) ** 2).sum((0, 2))


def sensed(
    record: Record, noise: NoiseModel, motion: Float[FloatArray, "*column channel counted group"]
) -> Float[FloatArray, "*column channel counted group"]:
    """Measured motion (..., channel, counted, group): the accelerometer's with its scale and lag."""
    if "accel" not in record.channels or (noise.sensor_scale == 1.0 and noise.sensor_lag == 0.0):
        return motion
    motion = motion.copy()
    accel = noise.sensor_scale * motion[..., 0, :, :]
    if noise.sensor_lag > 0:
        flat = accel.reshape(*accel.shape[:-2], -1)
        lost = -np.expm1(-record.dt / accel.shape[-1] / noise.sensor_lag)
        accel = np.asarray(lfilter([lost], [1, lost - 1], flat, axis=-1)).reshape(accel.shape)
    motion[..., 0, :, :] = accel
    return motion


def acting(
    record: Record, force: Float[FloatArray, "*column channel counted group"], onset: int | None
) -> Float[FloatArray, "*column channel counted group"]:
    """What a slope does (..., channel, counted, group), if only from `onset` on."""
    if onset is None:
        return force
    force = force.copy()
    if record.speed is not None:
        force[..., -1, :, :] -= force[..., -1, onset, :1][..., None, :]
    force[..., :onset, :] = 0.0
    return force
