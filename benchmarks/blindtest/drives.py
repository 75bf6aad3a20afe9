"""Manoeuvres and their drivers: cruise, following, stop-and-go, steps on a test track, and a recorded command."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter1d

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.io.us06 import US06_SPEED_MPS
from benchmarks.blindtest.body import coloured
from benchmarks.blindtest.vehicle import Pilot

Manoeuvre = Literal["cruise", "following", "stop_and_go", "steps"]
MANOEUVRES: tuple[Manoeuvre, ...] = get_args(Manoeuvre)
"""Kinds of drive.

Example:
    >>> import numpy as np
    >>> from benchmarks.blindtest import MANOEUVRES, draw_drive
    >>> draw_drive(np.random.default_rng(0)).manoeuvre in MANOEUVRES
    True
"""
DURATIONS_S = (60.0, 300.0, 900.0)
"""Lengths of the drives [s].

Example:
    >>> import numpy as np
    >>> from benchmarks.blindtest import DURATIONS_S, draw_drive
    >>> draw_drive(np.random.default_rng(0)).seconds in DURATIONS_S
    True
"""
RATES_HZ = (20, 25, 40, 50, 100)
"""Rates of the logs [Hz].

Example:
    >>> from benchmarks.blindtest import RATES_HZ
    >>> [1000 % rate for rate in RATES_HZ]  # whole steps of the reference vehicle's 1 ms
    [0, 0, 0, 0, 0]
"""
TYPICAL_SPEED_MPS = {"cruise": 25.0, "following": 16.0, "stop_and_go": 5.0, "steps": 17.0}
"""Reference speed for effects that depend on speed."""
ACCEL_MAX_MPS2, ACCEL_MIN_MPS2 = 2.0, -3.5


@dataclass(frozen=True)
class DrivePlan:
    """A drive to simulate: `manoeuvre`, `seconds`, `rate_hz` of the log, `seed` of its random events.

    `stops`: whether a cruise, or steps, come to a standstill once in four minutes, at least once. Raises `InputError`
    for an unknown manoeuvre.

    Example:
        >>> from benchmarks.blindtest import Car, DrivePlan, simulate
        >>> drive = DrivePlan("steps", seconds=10.0, rate_hz=50, seed=3)
        >>> run = simulate(Car(), drive.pilot(), seconds=drive.seconds, rate_hz=drive.rate_hz)
        >>> len(run.time) == 500
        True
    """

    manoeuvre: Manoeuvre
    seconds: float
    rate_hz: int
    seed: int
    stops: bool = False

    def __post_init__(self) -> None:
        if self.manoeuvre not in MANOEUVRES:
            raise InputError(f"manoeuvre: found {self.manoeuvre!r}, needs one of {', '.join(MANOEUVRES)}")

    def pilot(self) -> Pilot:
        """A fresh pilot; two pilots of the same drive act identically as long as the car does."""
        rng = np.random.default_rng([self.seed, MANOEUVRES.index(self.manoeuvre)])
        dt = 1 / self.rate_hz
        if self.manoeuvre in ("cruise", "steps"):
            driver = _Cruise(rng, self.seconds, dt) if self.manoeuvre == "cruise" else _Steps(rng, self.seconds)
            return _Stopping(driver, rng, self.seconds) if self.stops else driver
        if self.manoeuvre == "stop_and_go":
            return _Follow(rng, queue(rng, self.seconds, dt), dt)
        return _Follow(rng, (us06 if rng.random() < 0.4 else trip)(rng, self.seconds, dt), dt)


def draw_drive(rng: np.random.Generator, *, seconds: float | None = None, manoeuvre: str | None = None) -> DrivePlan:
    """Draw a drive; `seconds` and `manoeuvre` fix these instead of drawing them.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import draw_drive
        >>> drive = draw_drive(np.random.default_rng(0), seconds=60.0, manoeuvre="following")
        >>> drive.seconds, drive.manoeuvre
        (60.0, 'following')
    """
    return DrivePlan(
        manoeuvre=MANOEUVRES[int(rng.integers(4))] if manoeuvre is None else manoeuvre,  # type: ignore[arg-type]
        seconds=float(rng.choice(DURATIONS_S)) if seconds is None else seconds,
        rate_hz=int(rng.choice(RATES_HZ)),
        seed=int(rng.integers(2**31)),
    )


def with_stops(drive: DrivePlan) -> DrivePlan:
    """Every other drive that would not come to a standstill comes to one; its seed decides, so no draw is needed.

    Drives below 40 s have no time for it; following and stop-and-go have stops of their own.
    """
    can = drive.manoeuvre in ("cruise", "steps") and drive.seconds >= 40
    return replace(drive, stops=can and drive.seed % 2 == 0)


def _clip(u: float) -> float:
    return min(max(u, ACCEL_MIN_MPS2), ACCEL_MAX_MPS2)


class _Cruise:
    """Holds a set speed, which the driver changes occasionally by a few metres per second."""

    def __init__(self, rng: np.random.Generator, seconds: float, dt: float) -> None:
        speed, time, knots, speeds = float(rng.uniform(18, 30)), 0.0, [0.0], []
        self.start_speed = speed
        speeds.append(speed)
        while time < seconds:
            time += float(rng.uniform(6, 25))
            change = float(rng.uniform(1.5, 6)) * (1 if rng.random() < 0.5 else -1)
            new = speed + change if 15 < speed + change < 34 else speed - change
            takes = abs(change) / float(rng.uniform(0.5, 1.5))
            knots += [time, time + takes]
            speeds += [speed, new]
            speed, time = new, time + takes
        self._set = np.interp(np.arange(0, seconds + 1, dt), knots, speeds).tolist()
        self._gain, self._damping = float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.0, 0.15))
        self._ahead = round(float(rng.uniform(0.5, 1.5)) / dt)

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        ahead = self._set[min(row + self._ahead, len(self._set) - 1)]
        return _clip(self._gain * (ahead - speed) - self._damping * accel)


class _Follow:
    """Keeps a time gap to a leader: a linear law on spacing, both speeds and the measured own acceleration."""

    def __init__(self, rng: np.random.Generator, lead: np.ndarray, dt: float) -> None:
        self._lead = lead.tolist()
        self._gap, self._still = float(rng.uniform(1.3, 2.2)), float(rng.uniform(3, 6))
        self._spring, self._match = float(rng.uniform(0.06, 0.16)), float(rng.uniform(0.35, 0.7))
        self._damping = float(rng.uniform(0.0, 0.15))
        self.start_speed = max(self._lead[0], 0.0)
        begin = self._still + self._gap * self.start_speed + float(rng.uniform(-2, 5))
        self._place = (begin + np.concatenate([[0.0], np.cumsum(0.5 * dt * (lead[1:] + lead[:-1]))])).tolist()
        self._radar = (0.1 * rng.standard_normal(len(lead))).tolist()
        self.nearest = begin  # smallest spacing so far [m]; negative after a collision

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        spacing = self._place[row] - position
        self.nearest = min(self.nearest, spacing)
        measured, lead = spacing + self._radar[row], self._lead[row]
        if lead < 0.2 and speed < 0.5 and measured < self._still + 2.0:
            return -0.8  # stands with the brake on
        pull = self._spring * (measured - self._still - self._gap * speed) + self._match * (lead - speed)
        wish = min(pull, 1.6) - self._damping * accel
        closing = speed - lead
        if closing > 0:
            # deceleration that matches the leader's speed with 2 m to spare; a driver brakes no later than this
            needed = closing * closing / (2 * max(measured - 2.0, 0.3))
            if needed > 0.7:
                wish = min(wish, -1.3 * needed)
        return _clip(wish)


class _Steps:
    """Open-loop command steps held for one to six seconds, kept between walking pace and motorway speed."""

    def __init__(self, rng: np.random.Generator, seconds: float) -> None:
        count = int(seconds) + 2
        self._levels = (rng.choice([0.35, 1.0], count, p=[0.3, 0.7]) * rng.uniform(0.15, 1.0, count)).tolist()
        self._signs = np.where(rng.random(count) < 0.5, 1.0, -1.0).tolist()
        self._holds = rng.uniform(0.8, 5.0, count).tolist()
        self._rest = (rng.random(count) < 0.2).tolist()
        self._top = float(rng.uniform(22, 32))
        self.start_speed = float(rng.uniform(8, 18))
        self._next, self._at, self._until, self._value = 0, 0.0, 0.0, 0.0

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        leaving = (speed > self._top and self._value > 0) or (speed < 4.0 and self._value <= 0)
        if time >= self._until or (leaving and time > self._at + 0.3):
            i, self._next = self._next, min(self._next + 1, len(self._levels) - 1)
            sign = 1.0 if speed < 6.0 else -1.0 if speed > self._top - 2.0 else self._signs[i]
            size = self._levels[i] * (ACCEL_MAX_MPS2 if sign > 0 else -0.9 * ACCEL_MIN_MPS2)
            self._value = 0.0 if self._rest[i] and 6.0 <= speed <= self._top - 2.0 else sign * size
            self._at, self._until = time, time + self._holds[i]
        return self._value


class _Stopping:
    """Another pilot, who brakes to a standstill now and then, stands for some seconds, and pulls away again."""

    def __init__(self, pilot: Pilot, rng: np.random.Generator, seconds: float) -> None:
        self.start_speed = pilot.start_speed
        self._pilot = pilot
        count = max(1, round(seconds / 240))
        # in the middle of as many equal parts, so that a drive neither begins nor ends with one
        self._times = (seconds * (np.arange(count) + rng.uniform(0.3, 0.5, count)) / count).tolist()
        self._brake, self._pull = float(rng.uniform(1.5, 2.8)), float(rng.uniform(1.0, 1.8))
        self._stand = rng.uniform(2, 6, count).tolist()
        self._back, self._until = 0.0, float("inf")
        self._phase = "drive"

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        own = self._pilot.command(row, time, speed, accel, position)
        if self._phase == "drive" and self._times and time >= self._times[0]:
            self._times.pop(0)
            self._phase, self._back = "brake", 0.5 * speed
        if self._phase == "brake" and speed < 0.2:
            self._phase, self._until = "stand", time + self._stand.pop(0)
        if self._phase == "stand" and time >= self._until:
            self._phase = "pull"
        if self._phase == "pull" and speed > self._back:
            self._phase = "drive"
        return {"drive": own, "brake": -self._brake, "stand": -0.8, "pull": self._pull}[self._phase]


class Recorded:
    """Sends a recorded command row by row, whatever the car does: open loop.

    Args: `command` (row,) [m/s²]; `start_speed` [m/s].

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import Car, Recorded, simulate
        >>> pilot = Recorded(np.sin(np.arange(200) / 20), start_speed=20.0)
        >>> run = simulate(Car().silent(), pilot, seconds=10.0, rate_hz=20)
        >>> round(float(run.speed[0]), 1), len(run.command) == 200
        (20.0, True)
    """

    def __init__(self, command: ArrayLike, *, start_speed: float) -> None:
        self._command = np.asarray(command, float).tolist()
        self.start_speed = start_speed

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        return self._command[row]


# Leader speeds: synthetic trips similar to the WLTC, stop-and-go queues, and the US06 cycle.
_SMOOTH_S = 0.7


def trip(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """Town, road and motorway in turn, (row,) [m/s]: accelerations, holds with drift, slow-downs, occasional stops."""
    knots, speeds, time = [0.0], [float(rng.uniform(8, 20))], 0.0
    kind = int(rng.integers(3))
    left = float(rng.uniform(40, 120))
    while time < seconds:
        low, high = ((3.0, 14.0), (9.0, 24.0), (18.0, 33.0))[kind]
        target = float(rng.uniform(low, high))
        if kind == 0 and rng.random() < 0.2:
            target = 0.0
        pull = float(rng.uniform(0.4, 1.6) if target > speeds[-1] else rng.uniform(0.5, 2.2))
        takes = abs(target - speeds[-1]) / pull + 0.5
        holds = float(rng.uniform(3, 8) if target == 0 else rng.exponential(9.0) + 2.0)
        for more, speed in ((takes, target), (holds, target)):
            time += more
            knots.append(time)
            speeds.append(speed)
        left -= takes + holds
        if left < 0:
            kind, left = int(rng.integers(3)), float(rng.uniform(40, 120))
    return _smooth(np.interp(np.arange(0, seconds + 1, dt), knots, speeds), rng, dt)


def queue(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """Stop-and-go, (row,) [m/s]: short accelerations to 2 to 12 m/s, stops of a few seconds."""
    knots, speeds, time = [0.0], [float(rng.uniform(3, 8))], 0.0
    while time < seconds:
        target = float(rng.uniform(2, 12)) if speeds[-1] < 1.5 or rng.random() < 0.4 else float(rng.uniform(0, 1.5))
        target = 0.0 if target < 1.0 else target
        takes = abs(target - speeds[-1]) / float(rng.uniform(0.6, 2.0)) + 0.5
        holds = float(rng.uniform(2, 6))
        for more in (takes, holds):
            time += more
            knots.append(time)
            speeds.append(target)
    return _smooth(np.interp(np.arange(0, seconds + 1, dt), knots, speeds), rng, dt)


def us06(rng: np.random.Generator, seconds: float, dt: float) -> FloatArray:
    """A stretch of the US06 cycle from a random start, repeated from its beginning after its end, (row,) [m/s]."""
    grid = np.arange(0, seconds + 1, dt) + rng.uniform(0, len(US06_SPEED_MPS))
    table = np.asarray(US06_SPEED_MPS, float)
    speed = np.interp(grid, np.arange(len(table)), table, period=len(table))
    return np.asarray(np.maximum(gaussian_filter1d(speed, _SMOOTH_S / dt), 0.0))


def _smooth(speed: FloatArray, rng: np.random.Generator, dt: float) -> FloatArray:
    """Smoothed corners, and a driver's small random variation, which vanishes towards a stop."""
    wander = gaussian_filter1d(coloured(rng, len(speed), float(rng.uniform(0.2, 0.7)), 6.0, dt), 0.8 / dt)
    rounded = gaussian_filter1d(speed, _SMOOTH_S / dt)
    return np.asarray(np.maximum(rounded + wander * np.clip(rounded / 5.0, 0.0, 1.0), 0.0))
