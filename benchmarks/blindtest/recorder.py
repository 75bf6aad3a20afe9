"""What an ordinary recorder does to a log, and no simulator foretells: filters, quanta, clocks, vibration, lost rows.

A bus rounds a signal and sends it less often than the log has rows; a wheel-speed sensor averages; an accelerometer
vibrates with the body it is fixed to; each channel has its own clock; rows are lost, or written with the readings of
the row before. Now and then a driver overrides the controller, which goes on asking for the contrary. None of it is a
cause that a simulator lacks: it moves no car. A recorder changes `accel`, `speed`, `engaged`, the command under an
override, and which rows there are; other commands and the times of the rows that remain are kept to the bit.

The order is that of the signal path: clock offset, low-pass (speed), vibration and noise (accel), quantum, hold
(speed), overrides, then dropped and repeated rows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io import Log

FULL_VIBRATION_MPS = 30.0
"""Speed at which a recorder's vibration has its full RMS [m/s]; below and above it is proportional to speed."""
_DAMPING = 0.03  # damping ratio of a resonance: a peak some 6 % wide, whose phase wanders within seconds
_KMH = 1 / 3.6


@dataclass(frozen=True)
class Recorder:
    """What a recorder does to the readings of a car; the default, `Recorder.ideal()`, changes nothing.

    `speed_quantum` [m/s], `accel_quantum` [m/s²]: readings are rounded to multiples (0: not rounded).
    `speed_lag_s`: time constant of a first-order low-pass. `speed_hold_hz`: the speed is renewed this often and held
    in between (0: renewed in every row). `vibration_mps2`: RMS of the accelerometer's vibration at 30 m/s, in
    proportion to speed, shared equally among resonances at `vibration_hz`. `accel_noise_mps2`, `accel_noise_dof`: scale
    and degrees of freedom of t-distributed noise. `accel_offset_s`, `speed_offset_s`: age of a channel's readings by
    the clock of the command (negative: stamped too early). `dropped`, `repeated`: shares of rows that are lost, and
    that hold the readings of the row before. `overrides_per_min`, `override_s`: how often a driver takes over on
    average, and for how long [s]: the car does as before, by the driver's will, while `engaged` is 0 and the logged
    command is the opposite of what the car obeys.

    Raises `InputError` for values out of range.

    Example:
        >>> from benchmarks.blindtest import Recorder
        >>> held = Recorder(speed_hold_hz=20.0, speed_quantum=0.05)
        >>> held.speed_lag_s, held == Recorder.ideal()
        (0.0, False)
    """

    speed_quantum: float = 0.0
    speed_lag_s: float = 0.0
    speed_hold_hz: float = 0.0
    vibration_mps2: float = 0.0
    vibration_hz: tuple[float, ...] = ()
    accel_quantum: float = 0.0
    accel_noise_mps2: float = 0.0
    accel_noise_dof: float = 5.0
    accel_offset_s: float = 0.0
    speed_offset_s: float = 0.0
    dropped: float = 0.0
    repeated: float = 0.0
    overrides_per_min: float = 0.0
    override_s: float = 4.0

    def __post_init__(self) -> None:
        for name in (
            "speed_quantum",
            "speed_lag_s",
            "speed_hold_hz",
            "vibration_mps2",
            "accel_quantum",
            "accel_noise_mps2",
            "overrides_per_min",
            "override_s",
        ):
            if not 0 <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: found {getattr(self, name)!r}, needs a finite number of 0 or more")
        for name in ("accel_offset_s", "speed_offset_s"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name}: found {getattr(self, name)!r}, needs a finite number")
        for name in ("dropped", "repeated"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name}: found {getattr(self, name)!r}, needs a share from 0 to below 1")
        if not 0 < self.accel_noise_dof < math.inf:
            raise InputError(f"accel_noise_dof: found {self.accel_noise_dof!r}, needs a finite number above 0")
        if not all(0 < hertz < math.inf for hertz in self.vibration_hz):
            raise InputError(f"vibration_hz: found {self.vibration_hz!r}, needs finite frequencies above 0")
        if self.vibration_mps2 > 0 and not self.vibration_hz:
            raise InputError("vibration_hz: found none, needs the frequency of the vibration")

    @classmethod
    def ideal(cls) -> Recorder:
        """The recorder that writes every reading as it is."""
        return cls()

    def record(self, log: Log, seed: int) -> Log:
        """The log as this recorder would have written it; `seed` of vibration, noise and lost rows.

        Each channel and the rows have draws of their own, so a log without one channel is otherwise recorded alike.
        Raises `InputError` for a negative seed.

        Example:
            >>> from avtorch import Leader, simulate
            >>> from benchmarks.blindtest import Recorder
            >>> log = simulate(Leader.default(start=50.0, duration=20.0, dt=0.05)).log()
            >>> coarse = Recorder(accel_quantum=0.05, dropped=0.1).record(log, seed=1)
            >>> log.rows, coarse.rows < log.rows, round(float(coarse.accel[7]) / 0.05, 6) % 1.0
            (400, True, 0.0)
        """
        if seed < 0:
            raise InputError(f"seed: found {seed}, needs a whole number of 0 or more")
        if self == Recorder.ideal():
            return log
        accel = None if log.accel is None else self._accel(log, log.accel, seed)
        speed = None if log.speed is None else self._speed(log, log.speed)
        return self._rows(self._driven(replace(log, accel=accel, speed=speed), seed), seed)

    def _accel(self, log: Log, accel: FloatArray, seed: int) -> FloatArray:
        out = _shifted(log, accel, self.accel_offset_s)
        if self.vibration_mps2:
            # without a speed the body vibrates as at full speed
            share = 1.0 if log.speed is None else np.abs(log.speed) / FULL_VIBRATION_MPS
            each = self.vibration_mps2 / math.sqrt(len(self.vibration_hz))
            rng = np.random.default_rng([seed, 1])
            for hertz in self.vibration_hz:
                out = out + share * each * _resonance(rng, log.rows, hertz / log.rate_hz)
        if self.accel_noise_mps2:
            noise = np.random.default_rng([seed, 2]).standard_t(self.accel_noise_dof, log.rows)
            out = out + self.accel_noise_mps2 * noise
        return _rounded(out, self.accel_quantum)

    def _speed(self, log: Log, speed: FloatArray) -> FloatArray:
        out = _shifted(log, speed, self.speed_offset_s)
        if self.speed_lag_s:
            out = out.copy()
            keep = math.exp(-1 / (log.rate_hz * self.speed_lag_s))
            for part in log.segments():
                # settled at the first reading
                out[part] = lfilter([1 - keep], [1.0, -keep], out[part], zi=[keep * out[part.start]])[0]
        out = _rounded(out, self.speed_quantum)
        if self.speed_hold_hz:
            out = out.copy()
            for part in log.segments():
                since = log.elapsed[part] - log.elapsed[part.start]
                tick = np.floor(
                    since * self.speed_hold_hz + 1e-6
                )  # stamps such as 0.15 are a little short of their tick
                new = np.diff(tick, prepend=-1.0) > 0
                out[part] = out[part][_latest(new)]
        return out

    def _driven(self, log: Log, seed: int) -> Log:
        """A driver in charge from moments that chance decides: the motion stays, the logged command turns round."""
        if not self.overrides_per_min or log.accel_cmd is None:
            return log
        rng = np.random.default_rng([seed, 5])
        driver = np.zeros(log.rows, bool)
        for part in log.segments():
            time = log.elapsed[part]
            seconds = float(time[-1] - time[0])
            count = int(rng.poisson(self.overrides_per_min * seconds / 60))
            for begin in (time[0] + rng.uniform(0, seconds, count)).tolist():
                driver[part] |= (time >= begin) & (time < begin + self.override_s)
        return replace(
            log, accel_cmd=np.where(driver, -log.accel_cmd, log.accel_cmd), engaged=log.engaged & ~driver
        )  # fmt: skip

    def _rows(self, log: Log, seed: int) -> Log:
        """Rows are lost first, so a repeated row repeats the one that precedes it in the log."""
        starts = np.array([part.start for part in log.segments()])
        if self.dropped:
            kept = np.random.default_rng([seed, 3]).random(log.rows) >= self.dropped
            kept[starts] = True  # a segment begins where it began
            columns = {name: getattr(log, name) for name in log.__dataclass_fields__}
            log = replace(log, **{key: x[kept] for key, x in columns.items() if isinstance(x, np.ndarray)})
            starts = np.array([part.start for part in log.segments()])
        if self.repeated:
            new = np.random.default_rng([seed, 4]).random(log.rows) >= self.repeated
            new[starts] = True
            source = _latest(new)
            accel, speed = (None if x is None else x[source] for x in (log.accel, log.speed))
            log = replace(log, accel=accel, speed=speed)
        return log


def draw_recorder(rng: np.random.Generator, rate_hz: float) -> Recorder:
    """An ordinary recorder for logs of `rate_hz` rows per second.

    Speed: quantum 0.01 to 0.14 m/s, in one of three 0.1 km/h; low-pass of 20 to 80 ms; in logs above 20 Hz, every other
    one is held at 20 Hz. Accelerometer: one to three resonances of 3 to 20 Hz, below the log's Nyquist frequency, with
    0.02 to 0.15 m/s² together; quantum 0.01 to 0.05 m/s²; t-distributed noise of scale 0.01 to 0.05 m/s² with 3 to 10
    degrees of freedom. The clocks of command, accel and speed differ by up to 20 ms; up to 2 % of the rows are lost and
    up to 2 % repeated. In every other log a driver takes over 0.5 to 1.5 times a minute for 2 to 6 s. Raises
    `InputError` for a rate of 8 Hz or less, which shows no such vibration.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import draw_recorder
        >>> recorder = draw_recorder(np.random.default_rng(0), rate_hz=100)
        >>> 0.02 <= recorder.speed_lag_s <= 0.08, 3 <= min(recorder.vibration_hz), recorder.speed_hold_hz in (0.0, 20.0)
        (True, True, True)
    """
    if not 8 < rate_hz < math.inf:
        raise InputError(f"rate_hz: found {rate_hz!r}, needs a finite number above 8 Hz")

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    quantum = 0.1 * _KMH if rng.random() < 1 / 3 else between(0.01, 0.14)
    held = rng.random() < 0.5
    # an aliased vibration would be a cause outside the table
    highest = min(20.0, 0.45 * rate_hz)
    resonances = sorted(between(3.0, highest) for _ in range(int(rng.integers(1, 4))))
    command, accel, speed = rng.uniform(0.0, 0.02, 3).tolist()
    return Recorder(
        speed_quantum=quantum,
        speed_lag_s=float(rng.uniform(0.02, 0.08)),
        speed_hold_hz=20.0 if held and rate_hz > 20 else 0.0,
        vibration_mps2=between(0.02, 0.15),
        vibration_hz=tuple(resonances),
        accel_quantum=between(0.01, 0.05),
        accel_noise_mps2=between(0.01, 0.05),
        accel_noise_dof=float(rng.uniform(3.0, 10.0)),
        accel_offset_s=accel - command,
        speed_offset_s=speed - command,
        dropped=float(rng.uniform(0.0, 0.02)),
        repeated=float(rng.uniform(0.0, 0.02)),
        overrides_per_min=float(rng.uniform(0.5, 1.5)) if rng.random() < 0.5 else 0.0,
        override_s=float(rng.uniform(2.0, 6.0)),
    )


def _shifted(log: Log, x: FloatArray, late_s: float) -> FloatArray:
    """Readings (row,) that are `late_s` old; at the ends of a segment its first or last reading."""
    if late_s == 0.0:
        return x
    out = x.copy()
    for part in log.segments():
        time = log.elapsed[part]
        out[part] = np.interp(time - late_s, time, x[part])
    return out


def _rounded(x: FloatArray, quantum: float) -> FloatArray:
    return quantum * np.round(x / quantum) if quantum else x


def _latest(new: np.ndarray) -> np.ndarray:
    """(row,): the latest row so far at which `new` (row,) holds."""
    return np.maximum.accumulate(np.where(new, np.arange(len(new)), 0))


def _resonance(rng: np.random.Generator, rows: int, cycles: float) -> FloatArray:
    """White noise (row,) through a damped resonance of `cycles` per row: unit variance, stationary from the start."""
    decay = math.exp(-2 * math.pi * _DAMPING * cycles)
    first, second = 2 * decay * math.cos(2 * math.pi * cycles * math.sqrt(1 - _DAMPING**2)), -(decay**2)
    variance = (1 - second) / ((1 + second) * ((1 - second) ** 2 - first**2))
    settling = math.ceil(6 / (2 * math.pi * _DAMPING * cycles))
    driven = lfilter([1.0], [1.0, -first, -second], rng.standard_normal(settling + rows))
    return np.asarray(driven)[settling:] / math.sqrt(variance)
