"""Is a parameter of the simulator wrong? The user's own parameters, fitted to the car in their own terms.

The simulator is driven at its present values and beside each of them, and taken for linear between: `n + 1` times for
`n` parameters, and again at the better values, until these stay where they are. Slow simulators are asked seldom, and
never twice for the same values. Whether other values are needed at all is decided as it is for effects, by evidence,
and at their price (`LinearFit.evidence_over`): the recorder may be late and the noise of any colour either way.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed
from avtorch.external.linear_response import LinearFit, LinearResponse, rows_of
from avtorch.external.parameters import Limits
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.priors import EFFECT_NATS, ONE_CHANNEL_HZ
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.simulator_under_test import ParameterDifference
from avtorch.io import Log

_ROUNDS = 4  # of linearising
_BESIDE = 0.02  # of a parameter's range: where the simulator is driven beside its value
_STAYS = 0.02  # prior standard deviations, a hundredth of the range
_SURELY = 0.95  # of an interval that does not hold the present value

Values = Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The simulator's `outputs` by drive with the values that fit the car.

    `parameters`: what it had, and what the car has; they differ where the evidence says that other values are
    needed. `rollouts`: how many times the car's drives were driven through.
    """

    outputs: tuple[Log, ...]
    parameters: tuple[ParameterDifference, ...]
    rollouts: int

    @property
    def wrong(self) -> bool:
        return any(p.differs for p in self.parameters)


@dataclass(eq=False)
class Rollouts:
    """A simulator under the commands of the car's drives `logs`, by the values of its parameters; from `start` on.

    `drive` makes the outputs of the drives, for several values at once; none is driven twice. `seconds` it has taken.
    Raises `InputError` where more than `most` would be driven.
    """

    logs: Sequence[Log]
    start: Values
    drive: Callable[[Sequence[Values]], Sequence[Sequence[Log]]]
    most: int
    seconds: float = 0.0
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
            begun = clock.monotonic()
            driven = self.drive(list(new.values()))
            self._found |= {key: tuple(outputs) for key, outputs in zip(new, driven, strict=True)}
            self.seconds += clock.monotonic() - begun
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
    outputs = rollouts.at(values)
    needed = fit.evidence_over(plain) > EFFECT_NATS
    errors = dict(zip(limits, (fit.errors * ranges.scales).tolist(), strict=True))
    found = tuple(
        _difference(name, before[name], values[name], errors[name], data.frame_count - 1, needed) for name in limits
    )
    return Adjusted(outputs, found, len(rollouts))


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
    return np.array([rows_of(data, [_channel(out, name) for out in outputs]) for name in data.channels])


def _channel(output: Log, name: str) -> FloatArray:
    found = getattr(output, name)
    if found is None:
        raise InputError(f"{output.name}: has no {name}, needs the channels of the car's log")
    return found
