"""Is a parameter of the simulator wrong? The user's own parameters, fitted to the car in their own terms.

The simulator is driven at its present values and beside each of them, and taken for linear between: `n + 1` times for
`n` parameters, and again at the better values, until these stay where they are. Slow simulators are asked seldom, and
never twice for the same values. Whether other values are needed at all is decided as it is for effects: by blocks of
the drives that the fit has not seen (`RobustFit.evidence`).
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import t as student  # pyright: ignore[reportMissingTypeStubs]

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed
from avtorch.external.parameters import Limits
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import LATENESS, LATENESS_S
from avtorch.gap.budget.flexible_regression import left_over
from avtorch.gap.budget.noise_whitening import NoiseWhitening
from avtorch.gap.budget.robust_fit import Fit, HeldOut, RobustFit
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

    `parameters`: what it had, and what the car has; they differ where blocks held out agree that other values are
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
    cars = [replace(log, engaged=out.engaged) for log, out in zip(logs or rollouts.logs, first, strict=True)]
    record = AnalysisRecord.for_budget(cars)
    model = _Linear.around(record, cars, rollouts, before, limits)
    fitting = _fitting(record, model)
    fit = _fitted(fitting, model)
    for _ in range(_ROUNDS - 1):
        left = rollouts.most - len(rollouts)
        if np.abs(fit.z[: len(limits)]).max() < _STAYS or left < fewest_rollouts(limits):
            break
        model = _Linear.around(record, cars, rollouts, model.parameters(fit.z), limits)
        fit = _fitted(fitting, model)
    values = model.parameters(fit.z)
    outputs = rollouts.at(values)
    held = fitting.hold_out(fit)
    needed = fitting.evidence(_as_it_is(record, cars, fitting, first), held).strength(len(limits)) > 0
    errors = dict(zip(limits, (fitting.errors(fit)[: len(limits)] * _scales(limits)).tolist(), strict=True))
    found = tuple(
        _difference(name, before[name], values[name], errors[name], fitting.whitening.blocks - 1, needed)
        for name in limits
    )
    return Adjusted(outputs, found, len(rollouts))


def _as_it_is(record: AnalysisRecord, cars: Sequence[Log], fitting: RobustFit, first: Sequence[Log]) -> HeldOut:
    """The simulator as it is, of which nothing but the lateness of speed is fitted."""
    plain = _Linear(record, _measured(record, cars, first), np.zeros((0, *record.measured.shape)), {}, {})
    if plain.size:
        return fitting.hold_out(_fitted(fitting, plain))
    white = fitting.white(plain, np.zeros(0))
    return HeldOut(fitting.nats(white), np.zeros((0, 0)), white)


def _difference(name: str, before: float, value: float, sd: float, freedom: int, needed: bool) -> ParameterDifference:
    """`sd` is known by so many degrees of freedom."""
    reach, surely = (
        float(student.ppf(p, freedom)) * sd  # pyright: ignore[reportUnknownMemberType]
        for p in (0.95, 0.5 + _SURELY / 2)
    )
    car = Quantity(value, sd, value - reach, value + reach)
    return ParameterDifference(name, before, car, needed and abs(value - before) > surely, own=True)


def _fitting(record: AnalysisRecord, model: _Linear) -> RobustFit:
    """With the noise that is left once commands, speed and time have predicted what they can."""
    rough = RobustFit(NoiseWhitening.band(record, record.measured - model.center))
    return RobustFit(NoiseWhitening.autoregressive(record, left_over(rough, _fitted(rough, model))))


def _fitted(fitting: RobustFit, model: _Linear) -> Fit[_Linear]:
    return fitting.fit(model, np.zeros((1, model.size)), iterations=10)


def _measured(record: AnalysisRecord, cars: Sequence[Log], outputs: Sequence[Log]) -> FloatArray:
    """The outputs as the channels of the car's record, (channel, row) [m/s²]."""
    channels = {"accel": "accel" in record.channels, "speed": "speed" in record.channels}
    logs = [
        replace(log, **{name: getattr(out, name) if there else None for name, there in channels.items()})
        for log, out in zip(cars, outputs, strict=True)
    ]
    measured = AnalysisRecord.for_budget(logs).measured
    if measured.shape != record.measured.shape:  # it stands where the car does not, and too little is left
        raise InputError("logs: too little of them is driven by both car and simulator for its parameters to be fitted")
    return measured


@dataclass(frozen=True, eq=False)
class _Linear:
    """What `RobustFit` fits: `center` and `slopes` (parameter, channel, row) for one prior SD of each.

    The coordinates are those of the parameters named in `limits`, half of their range each, from `values` on, and, with
    two channels, how late speed is read against acceleration.
    """

    record: AnalysisRecord
    center: FloatArray
    slopes: FloatArray
    values: Values
    limits: Limits
    index: dict[str, slice] = field(init=False)
    low: FloatArray = field(init=False)
    high: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        ends = np.array([[x - self.values[n] for x in self.limits[n]] for n in self.limits]).reshape(-1, 2)
        low, high = (ends / _scales(self.limits)[:, None]).T
        index, slopes = {name: slice(n, n + 1) for n, name in enumerate(self.limits)}, self.slopes
        if len(self.record.channels) == 2:
            late = np.zeros_like(self.center)
            at = self.record.channels.index("speed")
            for stretch in self.record.stretches:
                late[at, stretch.rows] = -LATENESS_S * np.gradient(self.center[at, stretch.rows]) / self.record.dt
            index[LATENESS] = slice(len(low), len(low) + 1)
            slopes, low, high = np.concatenate([slopes, late[None]]), np.append(low, -6.0), np.append(high, 6.0)
        for name, value in (("slopes", slopes), ("index", index), ("low", low), ("high", high)):
            object.__setattr__(self, name, value)

    @classmethod
    def around(
        cls, record: AnalysisRecord, cars: Sequence[Log], rollouts: Rollouts, values: Values, limits: Limits
    ) -> _Linear:
        steps = {name: _BESIDE * (high - low) for name, (low, high) in limits.items()}
        steps = {name: x if values[name] + x <= limits[name][1] else -x for name, x in steps.items()}
        beside = [{**values, name: values[name] + step} for name, step in steps.items()]
        center, *others = (_measured(record, cars, outputs) for outputs in rollouts.each([values, *beside]))
        scales = zip(others, _scales(limits), steps.values(), strict=True)
        slopes = [(other - center) * scale / step for other, scale, step in scales]
        return cls(record, center, np.array(slopes), values, limits)

    @property
    def size(self) -> int:
        return len(self.low)

    def simulate(self, z: FloatArray) -> FloatArray:
        """(..., channel, row) at `z` (..., size)."""
        return self.center + np.tensordot(np.clip(z, self.low, self.high), self.slopes, 1)

    def traded(self, z: FloatArray) -> FloatArray:
        return np.zeros((0, len(z)))

    def named(self, z: FloatArray) -> dict[str, FloatArray]:
        """By name, at coordinates `z` (size,), each (1,)."""
        return {name: np.array([value]) for name, value in self.parameters(z).items()}

    def parameters(self, z: FloatArray) -> dict[str, float]:
        """By name, at coordinates `z` (size,)."""
        inside = np.clip(z, self.low, self.high)
        scales = zip(self.limits, _scales(self.limits), strict=True)
        return {name: float(self.values[name] + inside[n] * scale) for n, (name, scale) in enumerate(scales)}


def _scales(limits: Limits) -> FloatArray:
    """Prior standard deviations: half of each range."""
    return np.array([0.5 * (high - low) for low, high in limits.values()])
