"""The reference vehicle: a car simulated millisecond by millisecond, in plain Python, with or without effects.

It shares no code with the diagnosis. Every millisecond one car runs through the chain bus, conditioning, powertrain and
brake, body, sensors in plain numbers (about 2 us each; a batch in NumPy costs as much per car and makes every case
depend on its batch). What does not depend on the state is drawn beforehand in whole arrays. With no effect on, the
command held and no noise, its acceleration is GLVD's zero-order-hold solution.

Process noise is jerk noise through the actuation lag, added downstream of the actuator. In GLVD the two are equivalent,
so the noise-free response to the logged command is known to machine precision, whatever the effects.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from benchmarks.blindtest.actuator import actuator
from benchmarks.blindtest.body import coloured, driveline, forces
from benchmarks.blindtest.car import STEP_S, Car
from benchmarks.blindtest.command import Command, losses
from benchmarks.blindtest.sensors import Readings, filters


class Pilot(Protocol):
    """A driver: reads the car's measurements and sends one command per row."""

    start_speed: float

    def command(self, row: int, time: float, speed: float, accel: float, position: float) -> float:
        """The command of a row [m/s²]; `speed` and `accel` as measured, `position` [m] true (as from a radar)."""
        ...


@dataclass(frozen=True, eq=False)
class Run:
    """A drive of the reference vehicle, every field (row,).

    `time`, `command`, `accel`, `speed`: the logged signals. `noise_accel`: the part of `accel` that is process and
    sensor noise. `noise_speed`: the part of `speed` that is sensor noise and rounding; `drift_speed`: process noise
    integrated since the start of the drive, as the sensor shows it. `chance_accel`, `chance_speed`: the unpredictable
    part of an effect (gusts, outliers), the latter also integrated. `felt_accel`: how far the reading of process noise
    and gusts by a lagging or wrongly scaled accelerometer differs from these themselves. `true_accel`, `true_speed`,
    `position`: the car's own.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import Car, Recorded, simulate
        >>> run = simulate(Car(), Recorded(np.zeros(200), start_speed=20.0), seconds=10.0, rate_hz=20, seed=1)
        >>> bool(np.allclose(run.accel - run.noise_accel, run.true_accel, atol=0.1))
        True
    """

    time: FloatArray
    command: FloatArray
    accel: FloatArray
    speed: FloatArray
    noise_accel: FloatArray
    noise_speed: FloatArray
    drift_speed: FloatArray
    chance_accel: FloatArray
    chance_speed: FloatArray
    felt_accel: FloatArray
    true_accel: FloatArray
    true_speed: FloatArray
    position: FloatArray


def simulate(
    car: Car,
    pilot: Pilot,
    *,
    seconds: float,
    rate_hz: int,
    effects: Mapping[str, Mapping[str, float]] | None = None,
    onset: float = 0.0,
    seed: int = 0,
) -> Run:
    """Drive `car` for `seconds`, logged at `rate_hz` (a divisor of 1000); `effects` are on from `onset` [s].

    Args: `effects`: parameters by name (`benchmarks.blindtest.catalogue` draws them). The same `seed` gives the same
    noise, road and lost messages, whatever the effects. Raises `InputError` for a rate that does not divide 1000, fewer
    than two rows, or an onset outside the drive.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import Car, Recorded, simulate
        >>> step = Recorded(np.where(np.arange(200) < 20, 0.0, 1.0), start_speed=20.0)
        >>> late = {"dead_time": {"delay_s": 0.4}}
        >>> run = simulate(Car(T_L=0.3).silent(), step, seconds=10.0, rate_hz=20, effects=late)
        >>> round(float(run.time[np.argmax(run.accel > 0.01)]), 2)  # sent at 1 s
        1.45
    """
    if rate_hz < 1 or 1000 % rate_hz:
        raise InputError(f"rate_hz: found {rate_hz}, needs a divisor of 1000")
    rows, per_row = round(seconds * rate_hz), 1000 // rate_hz
    if rows < 2:
        raise InputError(f"seconds: found {seconds}, needs two rows or more")
    if not 0 <= onset < seconds:
        raise InputError(f"onset: found {onset}, needs a time in the drive of {seconds:g} s")
    return _Drive(car, pilot, rows, per_row, dict(effects or {}), onset, seed).run()


class _Drive:
    """The state of one simulated drive."""

    def __init__(
        self,
        car: Car,
        pilot: Pilot,
        rows: int,
        per_row: int,
        effects: dict[str, Mapping[str, float]],
        onset: float,
        seed: int,
    ) -> None:
        self.car, self.pilot, self.effects, self.seed = car, pilot, effects, seed
        self.rows, self.per_row, self.steps = rows, per_row, rows * per_row
        self.seconds, self.onset = self.steps * STEP_S, onset
        # an effect begins at a row: at row 0 the car has it from the start
        self.first = int(np.ceil(onset / (per_row * STEP_S) - 1e-9))
        # without speed limits from the effects, a car reaches 45 m/s at most
        self.reach = 45.0 * self.seconds

    def stream(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(name.encode())])

    def run(self) -> Run:
        self._draw()
        disturbance = (self.process + self.gust).tolist()
        disturbance.append(disturbance[-1])
        self._chain({}, None, 0.0, 0.0, 0.0)
        a_out, twist, speed, position = 0.0, 0.0, self.pilot.start_speed, 0.0
        total = disturbance[0]
        white_a, white_v = self.white_accel.tolist(), self.white_speed.tolist()
        quantum = self.car.speed_quantum
        accels, speeds, places, filtered, shown = [total], [speed], [position], [total], [speed]
        commands, readings_a, readings_v = [], [], []
        per_row, half = self.per_row, 0.5 * STEP_S
        for row in range(self.rows):
            time = row * per_row * STEP_S
            if row == self.first and self.effects:
                self._chain(self.effects, self.bus, a_out, filtered[-1], shown[-1])
            bus, actuate, push, filter_, of_speed, sensors, mode = (
                self.bus, self.actuate, self.push, self.filters, self.of_speed, self.sensors, self.mode,
            )  # fmt: skip
            read_a, read_v = self._read(sensors, time, filtered, accels, shown, places)
            read_a += white_a[row]
            read_v = max(read_v + white_v[row], 0.0)
            if quantum:
                read_v = quantum * round(read_v / quantum)
            command = self.pilot.command(row, time, read_v, read_a, position)
            bus.send(row, time, command)
            commands.append(command)
            readings_a.append(read_a)
            readings_v.append(read_v)
            for step in range(row * per_row, (row + 1) * per_row):
                time = step * STEP_S
                before = a_out
                a_out = actuate(bus.over(time), speed, time)
                if mode is not None:
                    twist = mode(a_out - before)
                ahead = a_out + twist + disturbance[step + 1]
                if push:
                    expected = speed + STEP_S * total
                    for force in push:
                        ahead += force(expected, position, time + STEP_S)
                new = speed + half * (total + ahead)
                if new <= 0.0:
                    # at rest the brake balances any backward force; it is released when the sum pulls forward
                    new, accel = 0.0, 0.0
                else:
                    accel = ahead
                position += half * (speed + new)
                speed, total = new, ahead
                accels.append(accel)
                speeds.append(new)
                places.append(position)
                if filter_:
                    for stage in filter_:
                        accel = stage(accel)
                filtered.append(accel)
                for stage in of_speed:
                    new = stage(new)
                shown.append(new)
        return self._logged(commands, readings_a, readings_v, accels, speeds, shown, places)

    def _draw(self) -> None:
        """Draw all random signals that do not depend on the car's motion."""
        car, steps = self.car, self.steps
        self.process = coloured(self.stream("process"), steps, car.process_sd, car.T_L)
        gust = self.effects.get("gust")
        self.gust = np.zeros(steps)
        if gust is not None:
            begin = self.first * self.per_row
            wind = coloured(self.stream("gust"), steps, gust["sd_mps2"], gust["time_constant_s"])[begin:]
            if begin:  # wind rises gradually from zero
                wind *= -np.expm1(-STEP_S * np.arange(len(wind)) / gust["time_constant_s"])
            self.gust[begin:] = wind
        self.base_accel = car.accel_sd * self.stream("accelerometer").standard_normal(self.rows)
        self.white_speed = car.speed_sd * self.stream("speed").standard_normal(self.rows)
        self.white_accel = self.base_accel.copy()
        heavy = self.effects.get("outliers")
        if heavy is not None:
            rng = self.stream("outliers")
            hit = (rng.random(self.rows) < heavy["fraction"]) & (np.arange(self.rows) >= self.first)
            # glitches of either sign, their size varying by about a factor of two
            size = heavy["scale"] * car.accel_sd * rng.uniform(0.6, 1.4, self.rows) * rng.choice([-1.0, 1.0], self.rows)
            self.white_accel[hit] += size[hit]

    def _chain(
        self,
        effects: Mapping[str, Mapping[str, float]],
        earlier: Command | None,
        a_out: float,
        accel: float,
        speed: float,
    ) -> None:
        """Build the chain with these effects, starting from the state of the earlier chain."""
        lost = None
        if "command_hold" in effects:
            lost = losses(self.stream("command_hold"), self.rows, effects["command_hold"]["hold_fraction"])
        phase = float(self.stream("delay_jitter").uniform(0, 2 * np.pi))
        self.bus = Command(effects, lost=lost, start=earlier.raw if earlier else 0.0, phase=phase)
        if earlier is not None:
            self.bus.take_over(earlier)
        self.actuate = actuator(self.car, effects, a_out)
        self.push = forces(effects, self.stream, reach=self.reach)
        self.mode = driveline(effects["driveline_oscillation"]) if "driveline_oscillation" in effects else None
        self.filters, self.of_speed = filters(effects, accel), filters(effects, speed, speed=True)
        self.sensors = Readings(effects, self.stream, reach=self.reach, seconds=self.seconds, onset=self.onset)

    def _read(
        self,
        sensors: Readings,
        time: float,
        filtered: list[float],
        accels: list[float],
        speeds: list[float],
        places: list[float],
    ) -> tuple[float, float]:
        """The row's readings of acceleration and speed, without sensor noise."""
        late = sensors.lateness(time)
        if late <= 0.0:
            a, v, raw, place = filtered[-1], speeds[-1], accels[-1], places[-1]
        else:
            back = min(late / STEP_S, len(speeds) - 2.0)
            whole = int(back)
            share, i = back - whole, len(speeds) - 1 - whole
            a, v, raw, place = (x[i] + share * (x[i - 1] - x[i]) for x in (filtered, speeds, accels, places))
        return sensors.accel(a, place, time), sensors.speed(v, raw, place, time)

    def _felt(self) -> FloatArray:
        """(row,): accelerometer reading of process noise and gusts, with lag and scale, minus these themselves."""
        begin, rows = self.first * self.per_row, np.arange(self.rows) * self.per_row
        motion = self.process + self.gust
        reading = motion.copy()
        if "sensor_lag" in self.effects:
            (late,) = filters({"sensor_lag": self.effects["sensor_lag"]}, float(motion[begin]))
            reading[begin:] = [late(x) for x in motion[begin:].tolist()]
        if "sensor_scale" in self.effects:
            reading[begin:] *= self.effects["sensor_scale"]["scale"]
        return (reading - motion)[rows]

    def _logged(
        self,
        commands: list[float],
        readings_a: list[float],
        readings_v: list[float],
        accels: list[float],
        speeds: list[float],
        shown: list[float],
        places: list[float],
    ) -> Run:
        rows = np.arange(self.rows) * self.per_row
        accel, speed = np.array(readings_a), np.array(readings_v)
        begin = self.first * self.per_row

        def summed(x: FloatArray) -> FloatArray:
            """The speed gained by `x` as the sensor shows it."""
            gained = np.cumsum(x) * STEP_S - 0.5 * STEP_S * (x + x[0])
            for late in filters(self.effects, float(gained[begin]), speed=True):
                gained[begin:] = [late(y) for y in gained[begin:].tolist()]
            return gained[rows]

        quantised = 0.0
        if self.car.speed_quantum:
            grid = self.car.speed_quantum
            fine = np.array(shown)[rows] + self.white_speed
            quantised = grid * np.round(fine / grid) - fine
        return Run(
            time=np.asarray(rows * STEP_S, np.float64),
            command=np.array(commands),
            accel=accel,
            speed=speed,
            noise_accel=self.process[rows] + self.base_accel,
            noise_speed=self.white_speed + quantised,
            drift_speed=summed(self.process),
            chance_accel=self.gust[rows] + self.white_accel - self.base_accel,
            chance_speed=summed(self.gust),
            felt_accel=self._felt(),
            true_accel=np.array(accels)[rows],
            true_speed=np.array(speeds)[rows],
            position=np.array(places)[rows],
        )
