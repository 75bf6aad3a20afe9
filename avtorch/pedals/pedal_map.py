"""The map from pedals and speed to the acceleration that they demand of the car.

Bilinear in pedal and speed between knots, as a simulator's table is read, so an exported table is the map itself.

A commanded speed stands in a map as what its controller acts on: the speed that is missing, and how fast the command
moves. The controller inside such a car demands m = f(speed_cmd - speed, speed) + g(d speed_cmd/dt, speed); more of
either never slows the car.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.io.mapping import PEDALS

ERROR, RATE = "speed_error", "speed_cmd_rate"
_HALF_S = 0.1  # a command that is held over two rows of 10 Hz does not jump
_JUMP_MPS2 = 10.0  # no car does it


def rate_of(log: Log) -> FloatArray:
    """How fast `speed_cmd` of a log moves (row,) [m/s²], over a fifth of a second about each row."""
    assert log.speed_cmd is not None
    out = np.zeros(log.rows)
    for part in log.segments():
        time, values = log.elapsed[part], log.speed_cmd[part]
        if len(time) < 2:
            continue
        half = max(_HALF_S, float(np.median(np.diff(time))))
        before, after = np.maximum(time - half, time[0]), np.minimum(time + half, time[-1])
        out[part] = (np.interp(after, time, values) - np.interp(before, time, values)) / (after - before)
    return out


def jumps(log: Log) -> bool:
    """Whether `speed_cmd` jumps, as a set speed does: no controller then adds its slope to what it demands."""
    return bool((np.abs(rate_of(log)[log.usable]) > _JUMP_MPS2).any())


def inputs_of(log: Log, names: Iterable[str]) -> dict[str, FloatArray]:
    """What a map takes, by name (row,): pedals of a log, or what its commanded speed asks. Raises `InputError` for what
    the log lacks."""
    out: dict[str, FloatArray] = {}
    for name in names:
        own = name if name in PEDALS else "speed_cmd"
        values = getattr(log, own)
        if values is None:
            raise InputError(f"{log.name}: has no {own}, which the map needs")
        if name == RATE:
            out[name] = rate_of(log)
        elif name == ERROR:
            if log.speed is None:
                raise InputError(f"{log.name}: has no speed, which the map needs")
            out[name] = values - np.maximum(log.speed, 0.0)
        else:
            out[name] = values
    return out


SIGN = {"throttle": 1.0, "brake": -1.0, "torque": 1.0, "current": 1.0, ERROR: 1.0, RATE: 1.0}
"""Whether more of a pedal makes the car faster or slower."""
_UNIT = {"throttle": "-", "torque": "Nm", "current": "A", ERROR: "m/s", RATE: "m/s2"}
_MOST_SHARE, _LEAST_PA = 1.2, 1e5
"""A brake up to 1.2 is a share of its way; a torque [Nm] never reaches 1e5, the 1 bar [Pa] that the pressure of a
braking car exceeds."""


def unit_of(name: str, largest: float) -> str:
    """The unit of a pedal in a log, that of a brake by the largest value.

    Example:
        >>> from avtorch.pedals.pedal_map import unit_of
        >>> [unit_of("brake", largest) for largest in (1.0, 2760.0, 4e6)]
        ['-', 'Nm', 'Pa']
    """
    if name != "brake":
        return _UNIT[name]
    return "-" if largest <= _MOST_SHARE else "Nm" if largest < _LEAST_PA else "Pa"


@dataclass(frozen=True, eq=False)
class PedalTable:
    """What one pedal adds: `accel` (pedal, speed) [m/s²] at the knots `pedal` (pedal,), zero where the pedal is zero.

    `sd` (pedal, speed): its standard errors by blocks of the drive, None where the map was not fitted.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable
        >>> weak = PedalTable(np.array([0.0, 1.0]), np.array([[0, 0], [1.0, -2.0]]))
        >>> PedalMap(np.array([0.0, 30.0]), np.zeros(2), {"throttle": weak})
        Traceback (most recent call last):
        ...
        avtorch.errors.InputError: throttle: found an acceleration that turns back, needs one that goes one way only
    """

    pedal: FloatArray
    accel: FloatArray
    sd: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class PedalMap:
    """The acceleration demanded: `coasting` (speed,) [m/s²] at the knots `speed` (speed,) [m/s], and what the `pedals`
    add by name; followed with a lag `T_L` [s] after a `dead_time` [s].

    `driven`: lowest and highest speed [m/s] of the drives that taught it, None where nothing is known; beyond them a
    map of pedals goes on along a line, and that of a commanded speed is held. The car's gain K_L is 1 by the map's
    scale: a car whose gain is halved has half the map. Raises `InputError` for knots that do not rise, tables of
    another shape, and an acceleration that turns back as a pedal goes on.

    Example:
        >>> import numpy as np
        >>> from avtorch.pedals import PedalMap, PedalTable
        >>> throttle = PedalTable(np.array([0.0, 0.1, 1.0]), np.array([[0, 0], [0, 0], [4.0, 2.0]]))
        >>> made = PedalMap(np.array([0.0, 30.0]), np.array([0.0, -0.6]), {"throttle": throttle})
        >>> made.accel(np.array([15.0, 15.0]), throttle=np.array([0.05, 0.55])).round(2).tolist()
        [-0.3, 1.2]
    """

    speed: FloatArray
    coasting: FloatArray
    pedals: Mapping[str, PedalTable]
    T_L: float = 0.3
    dead_time: float = 0.0
    coasting_sd: FloatArray | None = None
    driven: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.pedals or set(self.pedals) - set(SIGN):
            raise InputError(f"pedals: found {', '.join(self.pedals) or 'none'}, needs some of {', '.join(SIGN)}")
        _check("speed", self.speed, self.coasting, self.speed.shape)
        for name, table in self.pedals.items():
            _check(name, table.pedal, table.accel, (len(table.pedal), len(self.speed)))
            if (SIGN[name] * np.diff(table.accel, axis=0) < 0).any():
                raise InputError(f"{name}: found an acceleration that turns back, needs one that goes one way only")

    def accel(self, speed: FloatArray, **pedals: FloatArray) -> FloatArray:
        """The acceleration demanded (row,) [m/s²] at `speed` (row,) [m/s] and pedals (row,) by name.

        Beyond its knots the map goes on as at the last one. Raises `InputError` where a pedal is missing.
        """
        missing = [name for name in self.pedals if name not in pedals]
        if missing:
            raise InputError(f"pedals: found no {' and no '.join(missing)}, needs {', '.join(self.pedals)}")
        out = np.interp(speed, self.speed, self.coasting)
        for name, table in self.pedals.items():
            out = out + _bilinear(table.pedal, self.speed, table.accel, pedals[name], speed)
        return out

    def commanded(self, log: Log) -> Log:
        """The same drive with the acceleration that its pedals demand as `accel_cmd` (row,), in the place of any other.

        The part that depends on speed is that at the measured one. Raises `InputError` for a log without speed or
        without one of the pedals.
        """
        if log.speed is None:
            raise InputError(f"{log.name}: has no speed, which the map needs")
        return replace(log, accel_cmd=self.accel(np.maximum(log.speed, 0.0), **inputs_of(log, self.pedals)))


def _check(name: str, knots: FloatArray, values: FloatArray, shape: tuple[int, ...]) -> None:
    if values.shape != shape or len(knots) < 2 or not (np.diff(knots) > 0).all() or not np.isfinite(values).all():
        raise InputError(
            f"{name}: found {len(knots)} knots and values of shape {values.shape}, "
            f"needs two knots or more that rise and finite values of shape {shape}"
        )


def _bilinear(x: FloatArray, y: FloatArray, table: FloatArray, at_x: FloatArray, at_y: FloatArray) -> FloatArray:
    inside = np.column_stack([np.clip(at_x, x[0], x[-1]), np.clip(at_y, y[0], y[-1])])
    return RegularGridInterpolator((x, y), table)(inside)
