"""Add a known effect to a recorded car: the command is rewritten, and the measured response is kept.

A car with the log `(u, y)` is exactly equivalent to a car with an effect `E` upstream of it and the log `(u', y)`,
where `E(u') = u`. This gives a known effect together with a real response, its noise and its sensors; the unchanged log
is the control. Where the diagnosis of the changed log differs from that of the unchanged one, the difference is due to
the added effect, whatever else the car lacks.

Effects of the command are inverted exactly; a limit, beyond which nothing can be inverted, by dropping the rows that a
limited car would not have driven. A force `f` on the body is replaced by the equivalent command `u' = u - (f
+ T_L df/dt) / K_L`, with the car's lag and gain, which must be given. Effects of the accelerometer are applied to its
reading. Sizes are relative to the spread of the logged signals, so that size 1 is equally visible in any car.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.io import Log

Truth = dict[str, float]

_MOVING_MPS = 0.3
_SMOOTH_S = 0.3  # smooths the measured speed before a force is computed from it and differentiated
_GRAVITY = 9.81
_KNEE = 0.3  # of a limit, over which it sets in
_CREEPS_TO_MPS = 3.0
_LONGEST_MEMORY_S = 0.5
_SHORTEST_S = 1.0  # what is left between dropped rows


@dataclass(frozen=True)
class _Bench:
    """The log as the effects need it: one array per signal, `T_L` [s], `K_L` [-], random draws, size."""

    log: Log
    command: FloatArray
    T_L: float
    K_L: float
    size: float
    rng: np.random.Generator

    @property
    def step(self) -> float:
        return 1.0 / self.log.rate_hz

    @property
    def spread(self) -> float:
        """SD of the command in usable rows [m/s²]."""
        return float(self.command[self.log.usable].std())

    @property
    def speed(self) -> FloatArray:
        """Measured speed with most of its noise filtered out [m/s]."""
        if self.log.speed is None:
            raise InputError(f"{self.log.name}: has no speed, which this effect needs")
        smooth = self.log.speed.copy()
        for part in self.log.segments():
            smooth[part] = gaussian_filter1d(smooth[part], _SMOOTH_S / self.step, mode="nearest")
        return np.maximum(smooth, 0.0)

    def along(self) -> FloatArray:
        """Distance from the start of each segment [m]."""
        out = np.zeros(self.log.rows)
        for part in self.log.segments():
            v, t = self.speed[part], self.log.elapsed[part]
            out[part] = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
        return out

    def pushed(self, force: FloatArray) -> Log:
        """The log of a car with the additional `force` (row,) [m/s²]."""
        slope = np.zeros_like(force)
        for part in self.log.segments():
            if part.stop - part.start > 1:
                slope[part] = np.gradient(force[part], self.log.elapsed[part])
        return replace(self.log, accel_cmd=self.command - (force + self.T_L * slope) / self.K_L)


def put_in_front(
    log: Log, effect: str, *, T_L: float, K_L: float, size: float = 1.0, seed: int = 0
) -> tuple[Log, Truth]:
    """The log that a car with the additional `effect` would have written, and the effect's parameters.

    Args:
        effect: a name of `IN_FRONT`.
        T_L, K_L: lag [s] and gain [-] of the car, as fitted to the unchanged log.
        size: 1 is clearly visible; the functions below state what it scales.
        seed: of the random draws (times, roads, gusts, glitches).

    Raises `InputError` for an unknown effect, a log that lacks what it acts on, or a lag, gain or size out of range.

    Example:
        >>> from avtorch import Leader, simulate
        >>> from benchmarks.blindtest import put_in_front
        >>> log = simulate(Leader.default(start=50.0, duration=20.0, dt=0.05)).log()
        >>> changed, truth = put_in_front(log, "sensor_bias", T_L=0.3, K_L=1.0)
        >>> truth, round(float((changed.accel - log.accel).mean()), 2)
        ({'bias_mps2': 0.15415960099117626}, 0.15)
    """
    if effect not in IN_FRONT:
        raise InputError(f"effect: found {effect!r}, needs one of {', '.join(IN_FRONT)}")
    for name, value in (("T_L", T_L), ("K_L", K_L), ("size", size)):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name}: found {value}, needs a finite number above 0")
    if log.accel_cmd is None:
        raise InputError(f"{log.name}: has no accel_cmd, which is needed to add an effect")
    bench = _Bench(log, log.accel_cmd, float(T_L), float(K_L), float(size), np.random.default_rng(seed))
    return IN_FRONT[effect](bench)


# --- effects of the command -------------------------------------------------------------------------------------------
def _dead_time(x: _Bench) -> tuple[Log, Truth]:
    """`u'(t) = u(t + delay)`, 0.3 s at size 1, in whole rows; the last rows, whose command is unknown, are dropped."""
    rows = max(1, round(0.3 * x.size / x.step))
    command, kept = x.command.copy(), np.ones(x.log.rows, bool)
    for part in x.log.segments():
        n = part.stop - part.start
        command[part.start : part.stop - min(rows, n)] = x.command[part.start + min(rows, n) : part.stop]
        kept[part.stop - min(rows, n) : part.stop] = False
    return _rows(replace(x.log, accel_cmd=command), kept), {"delay_s": rows * x.step}


def _dead_band(x: _Bench) -> tuple[Log, Truth]:
    """`u' = u + w sign(u)`, w a quarter of the command's SD."""
    w = 0.25 * x.size * x.spread
    return replace(x.log, accel_cmd=x.command + w * np.sign(x.command)), {"half_width_mps2": w}


def _backlash(x: _Bench) -> tuple[Log, Truth]:
    """`u' = u + w sign(du/dt)`, w a fifth of the command's SD; where the command is constant, its last direction."""
    w = 0.2 * x.size * x.spread
    command = x.command.copy()
    for part in x.log.segments():
        side = np.sign(np.diff(x.command[part], prepend=x.command[part.start]))
        last = np.maximum.accumulate(np.where(side != 0, np.arange(len(side)), 0))
        command[part] += w * side[last]
    return replace(x.log, accel_cmd=command), {"half_width_mps2": w}


def _asymmetry(x: _Bench) -> tuple[Log, Truth]:
    """Brakes with 0.65 of the gain."""
    ratio = 0.65**x.size
    return (
        replace(x.log, accel_cmd=np.where(x.command < 0, x.command / ratio, x.command)),
        {"brake_gain_ratio": ratio, "brake_lag_ratio": 1.0},
    )


# --- effects of the actuator's gain -----------------------------------------------------------------------------------
def _gain_change(x: _Bench) -> tuple[Log, Truth]:
    """The gain falls to 0.7 at a time between 35 and 65 % of the drive."""
    ratio = 0.7**x.size
    first, last = float(x.log.elapsed[0]), float(x.log.elapsed[-1])
    when = first + (last - first) * float(x.rng.uniform(0.35, 0.65))
    command = np.where(x.log.elapsed >= when, x.command / ratio, x.command)
    return replace(x.log, accel_cmd=command), {"gain_ratio": ratio, "change_s": when}


def _speed_dependent_gain(x: _Bench) -> tuple[Log, Truth]:
    """The gain changes by half over one mean speed, up or down; never below 0.3."""
    v = x.speed
    slope = 0.5 * x.size * (1 if x.rng.random() < 0.5 else -1)
    mean = float(v[x.log.usable].mean())
    gain = np.maximum(1 + slope * (v - mean) / mean, 0.3)
    return replace(x.log, accel_cmd=x.command / gain), {"gain_slope": slope}


def _saturation(x: _Bench) -> tuple[Log, Truth]:
    """The drive's limit `L`, with a soft knee over its last 30 %, exceeded by a fifth of the positive commands.

    `E(u') = L - 0.3 L exp(-(u' - 0.7 L) / (0.3 L))` above `0.7 L`, which has an inverse below `L`. Rows beyond 0.99 L
    are dropped, and those that their acceleration still reaches: one lag, up to half a second.
    """
    push = x.command[x.log.usable & (x.command > 0)]
    if len(push) == 0:
        raise InputError(f"{x.log.name}: has no positive command, which this effect limits")
    limit = float(np.quantile(push, max(1 - 0.2 * x.size, 0.5)))
    knee = _KNEE * limit
    into = np.clip((x.command - (limit - knee)) / knee, 0.0, None)
    beyond = x.command > 0.99 * limit
    command = np.where(into > 0, limit - knee - knee * np.log1p(-np.minimum(into, 1 - 0.01 / _KNEE)), x.command)
    kept, memory = ~beyond, round(min(x.T_L, _LONGEST_MEMORY_S) / x.step)
    for part in x.log.segments():
        since = np.convolve(beyond[part], np.ones(memory + 1))[: part.stop - part.start]
        kept[part] &= since < 0.5
    return _stretches(replace(x.log, accel_cmd=command), kept, x.step), {"accel_max_mps2": x.K_L * limit}


# --- forces on the body -----------------------------------------------------------------------------------------------
def _resistance(x: _Bench) -> tuple[Log, Truth]:
    """Resistance of a quarter of the command's SD while the car moves."""
    r = 0.25 * x.size * x.spread
    force = np.full(x.log.rows, -r)
    if x.log.speed is not None:
        force[x.speed < _MOVING_MPS] = 0.0
    return x.pushed(force), {"resistance_mps2": r}


def _drag(x: _Bench) -> tuple[Log, Truth]:
    """Drag of 0.3 of the command's SD at the 90th percentile of speed."""
    v = x.speed
    c = 0.3 * x.size * x.spread / float(np.quantile(v[x.log.usable], 0.9)) ** 2
    return x.pushed(-c * v**2), {"drag_per_m": c}


def _grade(x: _Bench) -> tuple[Log, Truth]:
    """A sine over distance, its wavelength a sixth to a third of the drive, its amplitude 0.35 of the command's SD."""
    way = x.along()
    wave = float(way.max()) * float(x.rng.uniform(1 / 6, 1 / 3))
    pull = 0.35 * x.size * x.spread
    force = -pull * np.sin(2 * np.pi * (way / wave + float(x.rng.random())))
    return x.pushed(force), {"grade_rms": float(np.sqrt(np.mean(force[x.log.usable] ** 2))) / _GRAVITY}


def _creep(x: _Bench) -> tuple[Log, Truth]:
    """A push of 0.35 of the command's SD at standstill, which falls with the square of speed to 0 at 3 m/s."""
    push = 0.35 * x.size * x.spread
    return x.pushed(push * np.clip(1 - (x.speed / _CREEPS_TO_MPS) ** 2, 0.0, None)), {"creep_mps2": push}


def _gust(x: _Bench) -> tuple[Log, Truth]:
    """A coloured force: SD 0.3 of the command's, time constant 3 s."""
    sd, keep = 0.3 * x.size * x.spread, float(np.exp(-x.step / 3.0))
    kicks = x.rng.normal(size=x.log.rows) * sd * np.sqrt(1 - keep**2)
    kicks[0] = x.rng.normal() * sd
    return x.pushed(np.asarray(lfilter([1.0], [1.0, -keep], kicks))), {"sd_mps2": sd, "time_constant_s": 3.0}


# --- effects of the accelerometer -------------------------------------------------------------------------------------
def _accel(x: _Bench) -> FloatArray:
    if x.log.accel is None:
        raise InputError(f"{x.log.name}: has no accel, on which this effect acts")
    return x.log.accel


def _sensor_bias(x: _Bench) -> tuple[Log, Truth]:
    """An offset of a quarter of the reading's SD."""
    a = _accel(x)
    bias = 0.25 * x.size * float(a[x.log.usable].std())
    return replace(x.log, accel=a + bias), {"bias_mps2": bias}


def _sensor_scale(x: _Bench) -> tuple[Log, Truth]:
    """A reading of 1.2 times the true value."""
    scale = 1.2**x.size
    return replace(x.log, accel=_accel(x) * scale), {"scale": scale}


def _sensor_lag(x: _Bench) -> tuple[Log, Truth]:
    """A first-order filter with a time constant of 0.4 s."""
    a, lag = _accel(x).copy(), 0.4 * x.size
    keep = float(np.exp(-x.step / lag))
    for part in x.log.segments():
        a[part] = lfilter([1 - keep], [1.0, -keep], a[part], zi=[keep * a[part.start]])[0]
    return replace(x.log, accel=a), {"lag_s": lag}


def _outliers(x: _Bench) -> tuple[Log, Truth]:
    """One row in fifty is off by about twice the reading's SD."""
    a = _accel(x)
    sd = 2.0 * x.size * float(a[x.log.usable].std())
    hit = x.rng.random(x.log.rows) < 0.02
    return replace(x.log, accel=a + hit * x.rng.normal(0.0, sd, x.log.rows)), {"fraction": 0.02, "sd_mps2": sd}


IN_FRONT: Mapping[str, Callable[[_Bench], tuple[Log, Truth]]] = {
    "dead_time": _dead_time,
    "dead_band": _dead_band,
    "backlash": _backlash,
    "brake_throttle_asymmetry": _asymmetry,
    "gain_change": _gain_change,
    "speed_dependent_gain": _speed_dependent_gain,
    "constant_resistance": _resistance,
    "aerodynamic_drag": _drag,
    "road_grade": _grade,
    "gust": _gust,
    "sensor_bias": _sensor_bias,
    "sensor_scale": _sensor_scale,
    "sensor_lag": _sensor_lag,
    "outliers": _outliers,
    # behind the others: their places are part of the seeds of trials that were kept before
    "low_speed_creep": _creep,
    "saturation": _saturation,
}
"""Effects that can be added to a recording, by name; those of the accelerometer need `accel`.

Example:
    >>> from benchmarks.blindtest import EFFECTS, IN_FRONT
    >>> sorted(EFFECTS.keys() - IN_FRONT.keys())[:3]  # some that cannot be put in front of a log
    ['command_hold', 'driveline_oscillation', 'gear_shift']
"""


def _rows(log: Log, kept: BoolArray) -> Log:
    """The log with only the rows `kept` (row,)."""
    columns = {name: value[kept] for name, value in vars(log).items() if isinstance(value, np.ndarray)}
    columns = {name: value for name, value in columns.items() if name in log.__dataclass_fields__}
    return replace(log, **columns)


def _stretches(log: Log, kept: BoolArray, step: float) -> Log:
    """The log with only the rows `kept` (row,), each stretch between dropped rows a segment, if it lasts a second."""
    kept, cuts = kept.copy(), np.zeros(log.rows, int)
    for part in log.segments():
        edges = np.flatnonzero(np.diff(np.concatenate([[0], kept[part].astype(int), [0]]))) + part.start
        for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            kept[begin:end] = end - begin >= _SHORTEST_S / step
            cuts[begin] = 1
        cuts[part.start] = 1
    if not kept.any():
        raise InputError(f"{log.name}: no stretch of {_SHORTEST_S:g} s is left below the limit")
    segment = np.cumsum(cuts)[kept]
    number = np.unique(segment, return_inverse=True)[1]
    return replace(_rows(log, kept), segment=number.astype(log.segment.dtype))
