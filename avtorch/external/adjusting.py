r"""Is a parameter of the simulator wrong? The user's own parameters, fitted to the car in their own terms.

The simulator is driven at its present values and beside each of them, and taken for linear between: `n + 1` times for
`n` parameters, and again at the better values, until these stay where they are. Slow simulators are asked seldom, and
never twice for the same values. Behind a recorder it is

    y_c = F_c D_c [m_c + sum_i (z_i - z_i0) s_ci] + n_c,      z_i ~ N(0, 1)

with the simulator's readings m_c (row,) at z_0 and their slopes s_ci. Delays D_c and filters F_c of the recorder are
nuisance with the engine's priors, and the noise's covariance is free in each band of lapped coefficients and integrated
out (`avtorch.gap.engine.likelihood`). Gauss-Newton's steps solve least squares within limits. Whether other values are
needed at all is decided as it is for effects, by evidence, and at their price (`LinearFit.evidence_over`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError, listed
from avtorch.external.simulator import Limits, Values
from avtorch.gap.engine.compiled_plant import read_late
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import normal_prior
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import claimed, log_likelihood, whiten
from avtorch.gap.engine.priors import EFFECT_NATS, ONE_CHANNEL_HZ
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.simulator_under_test import ParameterDifference
from avtorch.io import Log

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
        return mean, np.where(self._late, np.hypot(sd, 0.5 * self.data.dt), sd)

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Least and greatest x."""
        plain = Hypothesis(self.data)
        low, high = np.concatenate([self.limits.reshape(-1, 2), [plain.limits(name) for name in self.recorder]]).T
        return np.where(self._late, np.minimum(low, -self.data.dt), low), high

    @property
    def _late(self) -> BoolArray:
        """Which of x are delays. The car's command moves between rows, where the simulator's is held, so that each
        channel may lead by a part of a row."""
        return np.array([False] * len(self.at) + [name.endswith("_delay") for name in self.recorder])

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


_ROUNDS = 4  # of linearising
_BESIDE = 0.02  # of a parameter's range: where the simulator is driven beside its value
_STAYS = 0.02  # prior standard deviations, a hundredth of the range
_SURELY = 0.95  # of an interval that does not hold the present value


@dataclass(frozen=True, eq=False)
class Adjusted:
    """`parameters`: what the simulator has, and what the car has; they differ where the evidence says that other values
    are needed. `outputs`: the simulator's by drive, with the car's values where they differ. `rollouts`: those made.
    """

    outputs: tuple[Log, ...]
    parameters: tuple[ParameterDifference, ...]
    rollouts: Rollouts

    @property
    def wrong(self) -> bool:
        return any(p.differs for p in self.parameters)


@dataclass(eq=False)
class Rollouts:
    """A simulator under the commands of the car's drives `logs`, by the values of its parameters; from `start` on.

    `drive` makes the outputs of the drives, for several values at once; none is driven twice.
    Raises `InputError` where more than `most` would be driven.
    """

    logs: Sequence[Log]
    start: Values
    drive: Callable[[Sequence[Values]], Sequence[Sequence[Log]]]
    most: int
    _found: dict[tuple[float, ...], tuple[Log, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self._found)

    def at(self, values: Values) -> tuple[Log, ...]:
        return self.each([values])[0]

    def each(self, places: Sequence[Values]) -> list[tuple[Log, ...]]:
        """The outputs at each of these values."""
        keys = [tuple(values.values()) for values in places]
        new = {key: values for key, values in zip(keys, places, strict=True) if key not in self._found}
        if len(self._found) + len(new) > self.most:
            raise InputError(f"most_rollouts: found {self.most}, needs more for {listed(self.start)} to settle")
        if new:
            driven = self.drive(list(new.values()))
            self._found |= {key: tuple(outputs) for key, outputs in zip(new, driven, strict=True)}
        return [self._found[key] for key in keys]


def fewest_rollouts(limits: Limits) -> int:
    """As it is, beside each value, and with the values that fit: alone, and once effects are known."""
    return len(limits) + 3


def adjusted(rollouts: Rollouts, limits: Limits, *, logs: Sequence[Log] | None = None) -> Adjusted:
    """The parameters named in `limits` fitted to the car's drives.

    `logs`: these drives less what else is known of the car; default: as they are. Rows in which the simulator stands,
    or the driver drives, do not count.
    Raises `InputError` as `Rollouts`, and for drives that are too short.
    """
    before = rollouts.start
    first = rollouts.at(before)
    cars = [
        replace(log, engaged=out.engaged & out.moving) for log, out in zip(logs or rollouts.logs, first, strict=True)
    ]
    data = DriveData.of(cars)
    if data.channel_count == 1:
        data = data.below(ONE_CHANNEL_HZ)
    ranges = _Ranges(before, limits)
    plain = LinearFit.of(LinearResponse(data, _readings(data, first), *_none(data)))
    fit = LinearFit.of(_around(data, rollouts, ranges, before))
    for _ in range(_ROUNDS - 1):
        left = rollouts.most - len(rollouts)
        if np.abs(fit.z - fit.model.at).max() < _STAYS or left < fewest_rollouts(limits):
            break
        fit = LinearFit.of(_around(data, rollouts, ranges, ranges.values(fit.z)))
    values = ranges.values(fit.z)
    better = rollouts.at(values)
    needed = fit.evidence_over(plain) > EFFECT_NATS
    errors = dict(zip(limits, (fit.errors * ranges.scales).tolist(), strict=True))
    found = tuple(
        _difference(name, before[name], values[name], errors[name], data.frame_count - 1, needed) for name in limits
    )
    return Adjusted(better if any(p.differs for p in found) else first, found, rollouts)


def _difference(name: str, before: float, value: float, sd: float, freedom: int, needed: bool) -> ParameterDifference:
    """`sd` is known by so many degrees of freedom."""
    reach, surely = (
        float(student.ppf(p, freedom)) * sd  # pyright: ignore[reportUnknownMemberType]
        for p in (0.95, 0.5 + _SURELY / 2)
    )
    car = Quantity(value, sd, value - reach, value + reach)
    return ParameterDifference(name, before, car, needed and abs(value - before) > surely, own=True)


@dataclass(frozen=True)
class _Ranges:
    """Parameters as z (parameter,): prior standard deviations, half of each range, from where they are `before`."""

    before: Values
    limits: Limits

    @property
    def scales(self) -> FloatArray:
        return np.array([0.5 * (high - low) for low, high in self.limits.values()])

    @property
    def ends(self) -> FloatArray:
        """Least and greatest z, (parameter, 2)."""
        return np.array([self.z({n: ends[k] for n, ends in self.limits.items()}) for k in (0, 1)]).T

    def z(self, values: Values) -> FloatArray:
        return np.array([values[name] - self.before[name] for name in self.limits]) / self.scales

    def values(self, z: FloatArray) -> dict[str, float]:
        low, high = np.array(list(self.limits.values())).T
        inside = np.clip(np.array([self.before[name] for name in self.limits]) + self.scales * z, low, high)
        return dict(zip(self.limits, inside.tolist(), strict=True))


def _around(data: DriveData, rollouts: Rollouts, ranges: _Ranges, values: Values) -> LinearResponse:
    """The simulator linearised at `values`, by a rollout beside each."""
    steps = {name: _BESIDE * (high - low) for name, (low, high) in ranges.limits.items()}
    steps = {name: x if values[name] + x <= ranges.limits[name][1] else -x for name, x in steps.items()}
    beside = [{**values, name: values[name] + step} for name, step in steps.items()]
    center, *others = (_readings(data, outputs) for outputs in rollouts.each([values, *beside]))
    scaled = np.array(list(steps.values())) / ranges.scales
    slopes = np.array([(other - center) / step for other, step in zip(others, scaled, strict=True)])
    return LinearResponse(data, center, slopes, ranges.z(values), ranges.ends)


def _none(data: DriveData) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Slopes, place and limits of no parameters."""
    return np.zeros((0, data.channel_count, len(data.time))), np.zeros(0), np.zeros((0, 2))


def _readings(data: DriveData, outputs: Sequence[Log]) -> FloatArray:
    """The outputs as readings (channel, row) of the car's channels."""
    out = np.empty((data.channel_count, len(data.time)))
    for channel, name in enumerate(data.channels):
        for number, output in enumerate(outputs):
            signal, own = getattr(output, name), data.log == number
            if signal is None:
                raise InputError(f"{output.name}: has no {name}, needs the channels of the car's log")
            out[channel, own] = signal[data.source[own, None] + np.arange(data.group)].mean(1)
    return out
