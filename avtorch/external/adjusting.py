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
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
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


class _Place(NamedTuple):
    """The unknowns `x` (size,), what is `left` (channel, frame, bin), its log likelihood [nats], and the noise's
    `covariance` (band, channel, channel)."""

    x: FloatArray
    left: FloatArray
    log_likelihood: float
    covariance: FloatArray


class LinearFit:
    """The simulator's readings `center` (channel, row) of acceleration [m/s²] and speed [m/s] at the parameters `at`
    (parameter,) and their `slopes` (parameter, channel, row), fitted to `data` behind a recorder.

    The unknowns x hold the parameters z from `low` to `high` (parameter,), in prior standard deviations from where they
    were, then delay and filter [s] of each channel.
    """

    def __init__(
        self, data: DriveData, center: FloatArray, slopes: FloatArray, at: FloatArray, low: FloatArray, high: FloatArray
    ) -> None:
        self.data, self.center, self.slopes, self.at = data, center, slopes, at
        recorder = [f"{channel}_{what}" for channel in data.channels for what in ("delay", "filter")]
        plain, none = Hypothesis(data), np.zeros(len(at))
        mean, sd = np.array([normal_prior(name, 0.0) for name in recorder]).T
        least, most = np.array([plain.limits(name) for name in recorder]).T
        # the car's command moves between rows, where the simulator's is held: each channel may lead by a part of a row
        sd[::2] = np.hypot(sd[::2], 0.5 * data.dt)
        least[::2] = np.minimum(least[::2], -data.dt)
        self.mean, self.sd = np.concatenate([none, mean]), np.concatenate([none + 1.0, sd])
        self.low, self.high = np.concatenate([low, least]), np.concatenate([high, most])
        self.best = self._place(np.concatenate([at, mean]))
        for _ in range(_ITERATIONS):
            before, self.best = self.best, self._stepped()
            if self._objective(self.best) - self._objective(before) < _STOP_NATS:
                break
        self.whitened = self._whitened(self.best)
        self.information = self.whitened @ self.whitened.T + np.diag(self.sd**-2.0)

    @property
    def z(self) -> FloatArray:
        """The simulator's parameters (parameter,)."""
        return self.best.x[: len(self.at)]

    def _place(self, x: FloatArray) -> _Place:
        x = np.clip(x, self.low, self.high)
        left = self.data.measured - self._response(x)
        return _Place(x, left, *log_likelihood(self.data, left))

    def _objective(self, place: _Place) -> float:
        """Log likelihood and priors, without constants [nats]."""
        return place.log_likelihood - 0.5 * float((((place.x - self.mean) / self.sd) ** 2).sum())

    def _stepped(self) -> _Place:
        """The place after a step of Gauss-Newton that gains, or the same one."""
        now, W = self.best, self._whitened(self.best)
        root = np.linalg.cholesky(W @ W.T + np.diag(self.sd**-2.0))
        downhill = W @ whiten(self.data, now.covariance, now.left) + (self.mean - now.x) / self.sd**2
        ends = self.low - now.x - 1e-12, self.high - now.x + 1e-12
        step = lsq_linear(root.T, np.linalg.solve(root, downhill), ends, "bvls").x
        return max([now, *(self._place(now.x + share * step) for share in (1.0, 0.3, 0.1))], key=self._objective)

    def _response(self, x: FloatArray) -> FloatArray:
        """Coefficients (channel, frame, bin)."""
        n = len(self.at)
        return self._recorded(self.center + np.tensordot(x[:n] - self.at, self.slopes, 1), x[n:])

    def _recorded(self, readings: FloatArray, recorder: FloatArray) -> FloatArray:
        """Coefficients (channel, frame, bin) of readings (channel, row) behind a recorder."""
        data, shown = self.data, dict[str, FloatArray]()
        for channel, x, (delay, filter_s) in zip(data.channels, readings, recorder.reshape(-1, 2), strict=True):
            late = np.empty_like(x)
            read_late(data.time, data.time, np.ascontiguousarray(x), delay, late)
            shown[channel] = data.low_pass(late, filter_s)
        speed = shown.get("speed")
        return data.transform(data.channel_rows(shown.get("accel"), None if speed is None else data.held(speed)))

    def _whitened(self, place: _Place) -> FloatArray:
        """Derivatives (size, coefficient) in units of the noise."""
        x, n = place.x, len(self.at)
        slopes = [self._recorded(slope, x[n:]) for slope in self.slopes]
        for i in range(n, len(x)):
            step = np.where(np.arange(len(x)) == i, _STEP_S, 0.0)
            below = x - step if x[i] - _STEP_S >= self.low[i] else x
            slopes.append((self._response(x + step) - self._response(below)) / (x[i] + _STEP_S - below[i]))
        return np.array([whiten(self.data, place.covariance, slope) for slope in slopes])

    def evidence_over(self, other: LinearFit) -> float:
        """Logarithm of the Bayes factor of this model over another one of the same data [nats], by Laplace.

        What is gained below 10 Hz alone, or above alone, does not count: a closed loop echoes noise.
        """
        low = claimed(self.data, self.best.covariance) - claimed(self.data, other.best.covariance)
        gain = self.best.log_likelihood - other.best.log_likelihood
        return min(low, gain) + self._volume - other._volume

    @property
    def _volume(self) -> float:
        """Of the posterior by that of the prior [nats]."""
        spread = float(np.linalg.slogdet(self.information * np.outer(self.sd, self.sd))[1])
        return -0.5 * spread - 0.5 * float((((self.best.x - self.mean) / self.sd) ** 2).sum())

    @property
    def errors(self) -> FloatArray:
        """Standard deviations (parameter,): the posterior's, or more where frames disagree by more (a sandwich;
        Huber 1967)."""
        data, size = self.data, len(self.best.x)
        residual = whiten(data, self.best.covariance, self.best.left)
        scores = (self.whitened * residual).reshape(size, data.channel_count, data.frame_count, -1).sum((1, 3))
        scores -= scores.mean(1, keepdims=True)
        inverse = np.linalg.inv(self.information)
        more = data.frame_count / max(data.frame_count - size, 1)
        sandwich = more * inverse @ scores @ scores.T @ inverse
        return np.sqrt(np.maximum(np.diag(sandwich), np.diag(inverse)))[: len(self.at)]


_ROUNDS = 4  # of linearising
_BESIDE = 0.04  # prior standard deviations: where the simulator is driven beside a value
_STAYS = 0.02  # prior standard deviations, a hundredth of the range
_SURELY = 0.95  # of an interval that does not hold the present value


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


def adjusted(
    rollouts: Rollouts, limits: Limits, *, logs: Sequence[Log] | None = None
) -> tuple[tuple[Log, ...], tuple[ParameterDifference, ...]]:
    """The parameters named in `limits` fitted to the car's drives: the simulator's outputs by drive, and each parameter
    of it beside the car's. They differ where the evidence says that other values are needed; the outputs are with the
    car's values then.

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
    low, high = np.array([*limits.values()]).T
    start, scale = np.array([before[name] for name in limits]), 0.5 * (high - low)

    def values(z: FloatArray) -> dict[str, float]:
        """Of parameters in prior standard deviations, half of each range, from where they are."""
        return dict(zip(limits, np.clip(start + scale * z, low, high).tolist(), strict=True))

    def linear(z: FloatArray) -> LinearFit:
        """By a rollout beside each value."""
        steps = np.where(start + scale * (z + _BESIDE) <= high, _BESIDE, -_BESIDE)
        places = [z, *(z + np.diag(steps))]
        here, *others = (_readings(data, outputs) for outputs in rollouts.each([values(place) for place in places]))
        slopes = np.array([(other - here) / step for other, step in zip(others, steps, strict=True)])
        return LinearFit(data, here, slopes, z, (low - start) / scale, (high - start) / scale)

    readings, none = _readings(data, first), np.zeros(0)
    plain = LinearFit(data, readings, np.zeros((0, *readings.shape)), none, none, none)
    fit = linear(np.zeros(len(limits)))
    for _ in range(_ROUNDS - 1):
        left = rollouts.most - len(rollouts)
        if np.abs(fit.z - fit.at).max() < _STAYS or left < fewest_rollouts(limits):
            break
        fit = linear(fit.z)
    car = values(fit.z)
    better = rollouts.at(car)
    needed = fit.evidence_over(plain) > EFFECT_NATS
    errors = dict(zip(limits, (fit.errors * scale).tolist(), strict=True))
    found = tuple(
        _difference(name, before[name], car[name], errors[name], data.frame_count - 1, needed) for name in limits
    )
    return better if any(p.differs for p in found) else first, found


def _difference(name: str, before: float, value: float, sd: float, freedom: int, needed: bool) -> ParameterDifference:
    """`sd` is known by so many degrees of freedom."""
    reach, surely = (
        float(student.ppf(p, freedom)) * sd  # pyright: ignore[reportUnknownMemberType]
        for p in (0.95, 0.5 + _SURELY / 2)
    )
    car = Quantity(value, sd, value - reach, value + reach)
    return ParameterDifference(name, before, car, needed and abs(value - before) > surely, own=True)


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
