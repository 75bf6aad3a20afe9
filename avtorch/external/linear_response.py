r"""A simulator that is linear in its parameters, behind a recorder, and its fit to a car.

    y_c = F_c D_c [m_c + sum_i (z_i - z_i0) s_ci] + n_c,      z_i ~ N(0, 1)

with the simulator's readings m_c (row,) at z_0 and their slopes s_ci. Delays D_c and filters F_c of the recorder are
nuisance with the engine's priors, and the noise's covariance is free in each band of lapped coefficients and integrated
out (`avtorch.gap.engine.likelihood`). Gauss-Newton's steps solve least squares within limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear

from avtorch.arrays import FloatArray
from avtorch.gap.engine.compiled_plant import read_late
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import normal_prior
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claimed, log_likelihood, whiten

_ITERATIONS = 12
_STEP_S = 0.004  # of a difference in a recorder's delay or filter
_STOP_NATS = 0.02


@dataclass(frozen=True, eq=False)
class LinearResponse:
    """What `data` would show of the simulator: readings `center` (channel, row) of acceleration [m/s²] and speed [m/s]
    at the parameters `at` (parameter,), and `slopes` (parameter, channel, row) by them.

    The vector x holds the parameters z within `limits` (parameter, 2), in prior standard deviations from where they
    were, then delay and filter [s] of each channel.
    """

    data: DriveData
    center: FloatArray
    slopes: FloatArray
    at: FloatArray
    limits: FloatArray

    @property
    def recorder(self) -> list[str]:
        return [f"{channel}_{what}" for channel in self.data.channels for what in ("delay", "filter")]

    @cached_property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation (size,)."""
        own = [normal_prior(name, 0.0) for name in self.recorder]
        mean, sd = np.array([*[(0.0, 1.0)] * len(self.at), *own]).T
        return mean, sd

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest x."""
        plain = Hypothesis(self.data)
        low, high = np.concatenate([self.limits.reshape(-1, 2), [plain.limits(name) for name in self.recorder]]).T
        return low, high

    def readings(self, z: FloatArray) -> FloatArray:
        """Of the simulator, (channel, row)."""
        return self.center + np.tensordot(z - self.at, self.slopes, 1)

    def recorded(self, readings: FloatArray, recorder: FloatArray) -> FloatArray:
        """Coefficients (channel, frame, bin) of readings (channel, row) behind a recorder."""
        shown: dict[str, FloatArray | None] = {"accel": None, "speed": None}
        for channel, x, (delay, filter_s) in zip(self.data.channels, readings, recorder.reshape(-1, 2), strict=True):
            late = np.empty_like(x)
            read_late(self.data.time, self.data.time, np.ascontiguousarray(x), delay, late)
            shown[channel] = self.data.low_pass(late, filter_s)
        speed = shown["speed"]
        return self.data.transform(
            self.data.channel_rows(shown["accel"], None if speed is None else self.data.held(speed))
        )

    def response(self, x: FloatArray) -> FloatArray:
        """Coefficients (channel, frame, bin) at x (size,)."""
        n = len(self.at)
        return self.recorded(self.readings(x[:n]), x[n:])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """Derivatives (size, channel, frame, bin)."""
        n = len(self.at)
        out = [self.recorded(slope, x[n:]) for slope in self.slopes]
        for i in range(n, len(x)):
            step = np.where(np.arange(len(x)) == i, _STEP_S, 0.0)
            below = x - step if x[i] - _STEP_S >= self.ends[0][i] else x
            out.append((self.response(x + step) - self.response(below)) / (x[i] + _STEP_S - below[i]))
        return np.array(out)


@dataclass(frozen=True, eq=False)
class LinearFit:
    """A `model` at its best `x` (size,), with the noise's `covariance` (band, channel, channel) there."""

    model: LinearResponse
    x: FloatArray
    residual: FloatArray = field(repr=False)
    log_likelihood: float
    covariance: FloatArray = field(repr=False)

    @classmethod
    def at(cls, model: LinearResponse, x: FloatArray) -> LinearFit:
        residual = model.data.measured - model.response(x)
        return cls(model, x, residual, *log_likelihood(model.data, residual))

    @classmethod
    def of(cls, model: LinearResponse) -> LinearFit:
        """By Gauss-Newton, from where the simulator stands."""
        mean, sd = model.prior
        fit = cls.at(model, np.clip(np.concatenate([model.at, mean[len(model.at) :]]), *model.ends))
        for _ in range(_ITERATIONS):
            W = fit.whitened
            root = np.linalg.cholesky(W @ W.T + np.diag(sd**-2.0))
            downhill = W @ whiten(model.data, fit.covariance, fit.residual) + (mean - fit.x) / sd**2
            low, high = (end - fit.x for end in model.ends)
            step = lsq_linear(root.T, np.linalg.solve(root, downhill), (low - 1e-12, high + 1e-12), "bvls").x
            tried = [cls.at(model, np.clip(fit.x + share * step, *model.ends)) for share in (1.0, 0.3, 0.1)]
            best = max(tried, key=lambda f: f.objective)
            gain = best.objective - fit.objective
            if gain > 0:
                fit = best
            if gain < _STOP_NATS:
                break
        return fit

    @property
    def z(self) -> FloatArray:
        """The simulator's parameters (parameter,)."""
        return self.x[: len(self.model.at)]

    @property
    def objective(self) -> float:
        """Log likelihood and priors, without constants [nats]."""
        mean, sd = self.model.prior
        return self.log_likelihood - 0.5 * float((((self.x - mean) / sd) ** 2).sum())

    @cached_property
    def whitened(self) -> FloatArray:
        """Derivatives (size, coefficient) in units of the noise."""
        slopes = self.model.jacobian(self.x)
        return np.array([whiten(self.model.data, self.covariance, slope) for slope in slopes])

    @cached_property
    def information(self) -> FloatArray:
        """(size, size), of likelihood and priors."""
        return self.whitened @ self.whitened.T + np.diag(self.model.prior[1] ** -2.0)

    def evidence_over(self, other: LinearFit) -> float:
        """Logarithm of the Bayes factor of this model over another one of the same data [nats], by Laplace.

        What is gained below 10 Hz alone, or above alone, does not count: a closed loop echoes noise.
        """
        data = self.model.data
        low = claimed(data, self.covariance) - claimed(data, other.covariance)
        return min(low, self.log_likelihood - other.log_likelihood) + self._volume - other._volume

    @property
    def _volume(self) -> float:
        """Of the posterior by that of the prior [nats]."""
        mean, sd = self.model.prior
        spread = np.linalg.slogdet(self.information * np.outer(sd, sd))[1]
        return -0.5 * float(spread) - 0.5 * float((((self.x - mean) / sd) ** 2).sum())

    @property
    def errors(self) -> FloatArray:
        """Standard deviations (parameter,): the posterior's, or more where frames disagree by more (a sandwich;
        Huber 1967)."""
        data, n, size = self.model.data, len(self.model.at), len(self.x)
        residual = whiten(data, self.covariance, self.residual)
        scores = (self.whitened * residual).reshape(size, data.channel_count, data.frame_count, -1).sum((1, 3))
        scores -= scores.mean(1, keepdims=True)
        inverse = np.linalg.inv(self.information)
        more = data.frame_count / max(data.frame_count - size, 1)
        sandwich = more * inverse @ scores @ scores.T @ inverse
        return np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse)))[:n]


def rows_of(data: DriveData, signals: Sequence[FloatArray]) -> FloatArray:
    """Rows (row,) of the data from signals (time,), one for each log."""
    out = np.empty(len(data.time))
    for number, signal in enumerate(signals):
        own = data.log == number
        out[own] = signal[data.source[own, None] + np.arange(data.group)].mean(1)
    return out
