"""How much any model could still predict: a flexible regression of rollout residuals, fitted to one part of the drives.

It contains no physics. Forces and sensor faults are smooth functions of past and present commands, of the rollout, of
speed and of time. Their coefficients have a normal prior, whose common scale is estimated from the fitted part by its
evidence, so the regression vanishes where there is no structure. What it predicts on held-out rows is a gap that a
better model could close; this gives a bound on the noise floor.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.basis import linear_splines, lowpass
from avtorch.gap.likelihood.whitening_filter import WhiteningFilter

_SIZES = np.exp(np.linspace(np.log(1e-3), np.log(10.0), 25))
_LAGS_S = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4)


@dataclass(frozen=True, eq=False)
class BlackBoxRegression:
    """Regressors (column, channel, counted, 1): the channels' response to unit forces and accelerometer faults."""

    record: Record
    columns: FloatArray

    @classmethod
    def of(cls, record: Record, rollout: FloatArray) -> BlackBoxRegression:
        """Regressors from a rollout (channel, counted, group) over the record."""
        forces = _shapes(record, rollout.mean(-1))
        channels = []
        if "accel" in record.channels:
            channels.append(forces)
        if "speed" in record.channels:
            channels.append(np.cumsum(forces, -1) * record.dt)
        columns = np.stack(channels, 1)
        if len(record.channels) == 2:
            faults = np.stack([forces, np.zeros_like(forces)], 1)
            columns = np.concatenate([columns, faults])
        return cls(record, columns[..., None])

    def predict(self, errors: FloatArray, white: WhiteningFilter) -> FloatArray:
        """Prediction of `errors` (channel, counted, group) over the whole record: (channel, counted, 1).

        Coefficients are fitted only to the rows that count in the record of `white`.
        """
        fits = np.isin(self.record.source, white.record.source)
        left = white(errors[:, fits].mean(-1, keepdims=True)).ravel()
        images = white(self.columns[:, :, fits]).reshape(len(self.columns), -1)
        # scaled by the regressor's size over the whole drive: one that is small on the fitted rows must not be inflated
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
    """Forces (column, counted) [m/s²], none of which depends on the same row's noise."""
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
