"""The reference vehicle driven along a drive that is known: what a model with exact equations predicts of a log.

A model of a car with only some of its causes would drive elsewhere, and a force that depends on speed or place would
then act elsewhere too. So commands, speed and position are taken from the drive, and only the response to them is
simulated: what can be predicted from commands, speed and place. No noise, no gusts, no outliers, no lost messages.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.blindtest.actuator import actuator
from benchmarks.blindtest.body import driveline, forces
from benchmarks.blindtest.car import STEP_S, Car
from benchmarks.blindtest.command import Command, Parameters
from benchmarks.blindtest.sensors import Readings, filters
from benchmarks.blindtest.vehicle import Run
from benchmarks.blindtest.visibility import exact_gain

_REACH_MPS = 45.0  # as the vehicle's, or roads would differ


@dataclass(frozen=True)
class Response:
    """Readings (row,) of a car without noise: `accel` [m/s²], and `speed` [m/s] up to what it has drifted since the
    start of the drive."""

    accel: FloatArray
    speed: FloatArray


@dataclass(frozen=True, eq=False)
class Replay:
    """A `run` of `car` with `effects` from `onset` [s] on, drawn by `seed`, to be driven again with some of them.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import Car, DrivePlan, simulate
        >>> from benchmarks.blindtest.replay import Replay
        >>> car, effects = Car().silent(), {"sensor_bias": {"bias_mps2": 0.2}}
        >>> pilot = DrivePlan("steps", seconds=10.0, rate_hz=50, seed=3).pilot()
        >>> replay = Replay(simulate(car, pilot, seconds=10.0, rate_hz=50, effects=effects), car, effects)
        >>> [round(float((replay.run.accel - replay.response(x).accel).max()), 3) for x in ((), ("sensor_bias",))]
        [0.2, 0.0]
    """

    run: Run
    car: Car
    effects: Parameters
    onset: float = 0.0
    seed: int = 0
    _known: dict[tuple[frozenset[str], float, float], Response] = field(default_factory=dict, repr=False)

    def response(self, names: Iterable[str], *, T_L: float | None = None, K_L: float | None = None) -> Response:
        """With the effects `names` alone, and with another lag [s] and gain if given."""
        car = replace(
            self.car, T_L=self.car.T_L if T_L is None else T_L, K_L=self.car.K_L if K_L is None else K_L
        )  # fmt: skip
        key = frozenset(names), car.T_L, car.K_L
        if key not in self._known:
            effects = {name: self.effects[name] for name in self.effects if name in key[0]}
            self._known[key] = self._driven(car, effects) if effects else self._bare(car)
        return self._known[key]

    def _bare(self, car: Car) -> Response:
        accel, speed = exact_gain(self.run.command, self.run.time[1] - self.run.time[0], car.T_L)
        return Response(car.K_L * accel, car.K_L * speed)

    def _stream(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, zlib.crc32(name.encode())])

    def _driven(self, car: Car, effects: Mapping[str, Mapping[str, float]]) -> Response:
        run, rows = self.run, len(self.run.time)
        per_row = round((run.time[1] - run.time[0]) / STEP_S)
        steps = (rows - 1) * per_row
        clock = np.arange(steps + 1) * STEP_S
        speeds = np.interp(clock, run.time, run.true_speed)
        at = np.interp(clock, run.time, run.position)
        v, x = speeds.tolist(), at.tolist()
        first, reach = int(np.ceil(self.onset / (per_row * STEP_S) - 1e-9)), _REACH_MPS * rows * per_row * STEP_S
        sends = run.command.tolist()
        phase = float(self._stream("delay_jitter").uniform(0, 2 * np.pi))
        bus, actuate = Command({}, lost=None), actuator(car, {}, 0.0)
        push, mode, stages = [], None, []
        a_out, twist, accel = 0.0, 0.0, 0.0
        accels, filtered = [0.0], [0.0]
        for row in range(rows - 1):
            if row == first:
                bus = Command(effects, lost=None, start=bus.raw, phase=phase).take_over(bus)
                actuate = actuator(car, effects, a_out)
                push = forces(effects, self._stream, reach=reach)
                mode = driveline(effects["driveline_oscillation"]) if "driveline_oscillation" in effects else None
                stages = filters(effects, filtered[-1])
            bus.send(row, row * per_row * STEP_S, sends[row])
            for step in range(row * per_row, (row + 1) * per_row):
                time, before = step * STEP_S, a_out
                a_out = actuate(bus.over(time), v[step], time)
                if mode is not None:
                    twist = mode(a_out - before)
                accel = a_out + twist
                for force in push:
                    accel += force(v[step + 1], x[step + 1], time + STEP_S)
                if v[step + 1] <= 0.0:
                    accel = 0.0
                accels.append(accel)
                for stage in stages:
                    accel = stage(accel)
                filtered.append(accel)
        return self._read(effects, np.array(accels), np.array(filtered), speeds, at, per_row, first, reach)

    def _read(
        self,
        effects: Parameters,
        accels: FloatArray,
        filtered: FloatArray,
        speeds: FloatArray,
        at: FloatArray,
        per_row: int,
        first: int,
        reach: float,
    ) -> Response:
        """Rows of the readings: those of the drive's own speed, and what the simulated motion differs from it."""
        gained = np.concatenate([[0.0], np.cumsum(0.5 * STEP_S * (accels[1:] + accels[:-1]))])
        rows, begin = len(self.run.time), first * per_row
        for late in filters(effects, float(gained[begin]), speed=True):
            gained[begin:] = [late(y) for y in gained[begin:].tolist()]
        # the vehicle's own arguments, so that its roads and phases come out alike
        seconds = rows * per_row * STEP_S
        without = Readings({}, self._stream, reach=reach, seconds=seconds, onset=self.onset)
        sensors = Readings(effects, self._stream, reach=reach, seconds=seconds, onset=self.onset)
        accel, speed = np.zeros(rows), np.zeros(rows)
        for row in range(rows):
            time, sensor = row * per_row * STEP_S, sensors if row >= first else without
            i = max(row * per_row - sensor.lateness(time) / STEP_S, 0.0)
            whole = min(int(i), len(speeds) - 1)
            share, ahead = i - whole, min(whole + 1, len(speeds) - 1)
            a, v, raw, place, moved = (
                float(s[whole] + share * (s[ahead] - s[whole])) for s in (filtered, speeds, accels, at, gained)
            )
            accel[row] = sensor.accel(a, place, time)
            speed[row] = sensor.speed(v, raw, place, time) - v + moved
        return Response(accel, speed)
