"""How far any model could go: a flexible regression of what a rollout leaves over, fitted to one part of the drives.

It has no physics in it. Forces and sensor faults are smooth functions of commands past and present, of what the rollout
does, of speed and of time; their coefficients are normal a priori, of one size that the fitted part chooses itself by
its evidence, so that where nothing is left the regression is nothing. What it foretells of rows it has not seen is a
gap that could be closed and is not: where the floor is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.basis import linear_splines, lowpass
from avtorch.gap.likelihood.record import Record
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter

_SIZES = np.exp(np.linspace(np.log(1e-3), np.log(10.0), 25))
_LAGS_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)


@dataclass(frozen=True, eq=False)
class BlackBoxRegression:
    """Columns (column, channel, counted, 1): what unit forces and unit faults of the accelerometer show."""

    record: Record
    columns: FloatArray

    @classmethod
    def of(cls, record: Record, rollout: FloatArray) -> BlackBoxRegression:
        """From a rollout (channel, counted, group) over the record."""
        forces = _shapes(record, rollout.mean(-1))
        seen = []
        if "accel" in record.channels:
            seen.append(forces)
        if "speed" in record.channels:
            seen.append(np.cumsum(forces, -1) * record.dt)
        columns = np.stack(seen, 1)
        if len(record.channels) == 2:
            faults = np.stack([forces, np.zeros_like(forces)], 1)
            columns = np.concatenate([columns, faults])
        return cls(record, columns[..., None])

    def foretold(self, errors: FloatArray, white: WhiteningFilter) -> FloatArray:
        """What the regression makes of `errors` (channel, counted, group), seen only where the `white` one's record
        counts: (channel, counted, 1) over the whole record.
        """
        fits = np.isin(self.record.source, white.record.source)
        left = white(errors[:, fits].mean(-1, keepdims=True)).ravel()
        images = white(self.columns[:, :, fits]).reshape(len(self.columns), -1)
        # by what they do to the whole drive: what hardly acts where it is fitted must not grow
        whole = replace(white, record=self.record)(self.columns).reshape(len(self.columns), -1)
        scale = np.sqrt((whole**2).mean(-1))
        use = scale > 1e-9 * scale.max(initial=1e-300)
        images = images[use] / scale[use, None]
        values, axes = np.linalg.eigh(images @ images.T)
        values, match = np.maximum(values, 0.0), axes.T @ (images @ left)
        square = _SIZES[:, None] ** 2
        evidence = 0.5 * (match**2 * square / (1 + square * values) - np.log1p(square * values)).sum(1)
        weights = np.exp(evidence - np.logaddexp.reduce(evidence))
        taken = weights @ (square / (1 + square * values))
        coefficients = axes @ (taken * match) / scale[use]
        columns = self.columns[use]
        return (coefficients @ columns.reshape(len(columns), -1)).reshape(columns.shape[1:])


def _shapes(record: Record, rollout: FloatArray) -> FloatArray:
    """Forces (column, counted) [m/s²]; nothing that a row's own noise has touched."""
    dt = record.dt
    a = rollout[0] if "accel" in record.channels else np.gradient(rollout[-1]) / dt
    u = record.command[record.source]
    t = np.linspace(0.0, 1.0, record.rows)
    v = np.zeros(record.rows)
    if record.speed is not None:
        v = lowpass(record.speed.mean(-1)[record.source], 0.5, dt)
    jerk = np.gradient(a) / dt
    past = [lowpass(u, s, dt) for s in _LAGS_S]
    push, brake = np.maximum(u, 0.0), np.minimum(u, 0.0)
    one_sided = [lowpass(x, s, dt) for x in (push, brake) for s in (0.2, 0.8, 3.2)]
    play = [np.tanh(jerk / s) for s in (0.1, 0.5, 2.0)] + [np.tanh((u - a) / s) for s in (0.05, 0.2)]
    of_a, of_u, of_v, of_t = linear_splines(a, 9), linear_splines(u, 9), linear_splines(v, 7), linear_splines(t, 7)
    columns = [u, a, jerk, *past, *one_sided, *play, *of_a, *of_u, *of_v, *of_t, *(a * of_v), *(a * of_t)]
    columns += [*(jerk * of_v), *((u - a) * of_v), *((u - a) * of_t), v**2 / 400]
    return np.stack(columns)
