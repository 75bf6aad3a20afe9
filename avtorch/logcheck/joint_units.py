"""Units of command, acceleration and speed, tested together: what one unit makes of the others must be one motion.

km/h with g fits each of them alone as well as m/s with m/s². Together only one choice makes the change of speed the
integral of the acceleration, and both the answer to the command. What the headers state counts, too, but less than a
plain contradiction by the data: a header can be wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.units import factor
from avtorch.io.validity import DELAYS_S, Scale, integral, late_response, scale_between

# natural logarithms of how much rarer a unit is than SI in logs of cars
_SPEED = {"m/s": 0.0, "km/h": 0.5, "mph": 1.0, "kn": 4.0, "ft/s": 4.0, "cm/s": 4.0, "mm/s": 5.0}
_ACCEL = {"m/s2": 0.0, "g": 0.7, "km/h/s": 3.0, "mg": 3.0, "cm/s2": 4.0, "ft/s2": 4.5, "mm/s2": 5.0}
_STATED = 2.5  # nats that a header's unit is worth
_TURNED = 4.0  # nats that a sensor mounted backwards costs
_ALIKE = 1.0  # nats that one unit for command and acceleration is worth
_SAME_MOTION = 0.12  # spread of the logarithm of their scale where two channels measure one motion
# recordings exist whose acceleration is 1.8 times the slope of their speed: one in ten is taken to have such a channel
_MISCALIBRATED, _SHARE = 0.3, 0.1
_RESPONSE, _GAIN = 0.35, 0.95  # the same of a car's answer to its command, and its middle
_WORST = 40.0
_SURE = 0.7  # correlation from which a scale says something
_SPEED_MPS, _SPEED_SPREAD = 35.0, 8.0  # of the 99th percentile, above which speeds are rare
_ACCEL_MPS2, _ACCEL_SPREAD = 0.8, 1.2
_PLAIN = 3.0
"""Nats by which a choice must lead all others of other units for them to be ruled out."""


@dataclass(frozen=True)
class UnitChoice:
    """A unit for each of the signals, as `avtorch.io.units` names it; its `cost` in nats; `turned` signals."""

    units: Mapping[str, str]
    cost: float
    turned: tuple[str, ...] = ()


@dataclass(frozen=True)
class UnitTest:
    """The best choice, the next one with other units if the data do not rule it out, and the scales it rests on."""

    best: UnitChoice
    rival: UnitChoice | None
    scales: Mapping[tuple[str, str], Scale]


def units_together(
    time: FloatArray, signals: Mapping[str, FloatArray], stated: Mapping[str, str | None], parts: list[slice]
) -> UnitTest:
    """The units of `signals` (row,), of `accel_cmd`, `accel` and `speed` those that are there, in their own units.

    `time` (row,) [s]; `stated`: what headers say; `parts`: stretches of rows that may be compared.
    """
    scales = _scales(time, signals, parts)
    options: dict[str, list[tuple[str, float, bool]]] = {}
    for name, values in signals.items():
        rarity = _SPEED if name == "speed" else _ACCEL
        options[name] = []
        for unit, rare in rarity.items():
            told = stated.get(name)
            cost = (rare if told is None else 0.0 if unit == told else _STATED + rare) + _by_size(name, values, unit)
            options[name] += [(unit, cost, False)] + ([] if name == "speed" else [(unit, cost + _TURNED, True)])
    choices = []
    for combination in product(*options.values()):
        of = dict(zip(options, combination, strict=True))
        cost = sum(cost for _, cost, _ in combination) + _by_motion(of, scales)
        both = [of[name][0] for name in ("accel_cmd", "accel") if name in of]
        if len(both) == 2 and both[0] == both[1]:
            cost -= _ALIKE
        turned = tuple(name for name, (_, _, turned) in of.items() if turned)
        choices.append(UnitChoice({name: unit for name, (unit, _, _) in of.items()}, cost, turned))
    choices.sort(key=lambda choice: choice.cost)
    best = choices[0]
    rival = next((c for c in choices[1:] if c.cost < best.cost + _PLAIN), None)
    return UnitTest(best, rival, scales)


def _scales(time: FloatArray, signals: Mapping[str, FloatArray], parts: list[slice]) -> dict[tuple[str, str], Scale]:
    """Raw scales between the signals: change of the first per integral of the second."""
    found: dict[tuple[str, str], Scale] = {}
    if "speed" in signals and "accel" in signals:
        _keep(found, ("speed", "accel"), scale_between(time, parts, signals["speed"], signals["accel"]))
    if "accel_cmd" in signals:
        u = signals["accel_cmd"]
        if "speed" in signals:
            _keep(found, ("speed", "accel_cmd"), _response(time, parts, signals["speed"], u))
        if "accel" in signals:
            level = integral(time, signals["accel"])
            _keep(found, ("accel", "accel_cmd"), _response(time, parts, level, u))
    return found


def _keep(found: dict[tuple[str, str], Scale], pair: tuple[str, str], scale: Scale | None) -> None:
    if scale is not None and abs(scale.correlation) >= _SURE and scale.slope != 0:
        found[pair] = scale


def _response(time: FloatArray, parts: list[slice], level: FloatArray, u: FloatArray) -> Scale | None:
    found = scale_between(time, parts, level, u, delays=DELAYS_S)
    if found is not None and found.slope < 0 and late_response(time, parts, level, u)[1]:
        return None  # inverted, or late by half a period: the data cannot tell
    return found


def _by_motion(of: Mapping[str, tuple[str, float, bool]], scales: Mapping[tuple[str, str], Scale]) -> float:
    cost = 0.0
    for (level, rate), scale in scales.items():
        signed = scale.slope * factor(level, of[level][0]) / factor(rate, of[rate][0])
        signed *= (-1.0 if of[level][2] else 1.0) * (-1.0 if of[rate][2] else 1.0)
        weight = scale.correlation**2
        if signed <= 0:
            cost += _WORST * weight
        elif (level, rate) == ("speed", "accel"):
            cost += weight * min(_WORST, _off_motion(math.log(signed)))
        else:
            cost += weight * min(_WORST, 0.5 * (math.log(signed / _GAIN) / _RESPONSE) ** 2)
    return cost


def _off_motion(off: float) -> float:
    """What a scale costs that is `off` 1 by its logarithm, of two channels that measure one motion."""
    good = (1 - _SHARE) * math.exp(-0.5 * (off / _SAME_MOTION) ** 2)
    bad = _SHARE * _SAME_MOTION / _MISCALIBRATED * math.exp(-0.5 * (off / _MISCALIBRATED) ** 2)
    return -math.log(max(good + bad, 1e-300))


def _by_size(name: str, values: FloatArray, unit: str) -> float:
    """What sizes cost that cars do not have."""
    size = np.abs(values[np.isfinite(values)]) * factor(name, unit)
    if not len(size):
        return 0.0
    if name == "speed":
        top = float(np.quantile(size, 0.99))
        return min(_WORST, 0.5 * (max(top - _SPEED_MPS, 0.0) / _SPEED_SPREAD) ** 2)
    rms = float(np.sqrt(np.mean(size**2)))
    return min(_WORST, 0.5 * (math.log(max(rms, 1e-9) / _ACCEL_MPS2) / _ACCEL_SPREAD) ** 2)
