"""The reference vehicle as a simulator: a whole drive at once, or step by step."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avtorch.arrays import FloatArray
from benchmarks.blindtest import Car, Recorded, simulate
from benchmarks.blindtest.actuator import actuator
from benchmarks.blindtest.body import forces
from benchmarks.blindtest.car import STEP_S
from benchmarks.blindtest.command import Command

Effects = Mapping[str, Mapping[str, float]]
OWN = {"dead_time", "second_order_actuator", "speed_dependent_gain", "aerodynamic_drag"}
_FAR_M = 1e4


def whole_drive(
    car: Car, effects: Effects, command: FloatArray, rate_hz: int, *, speed: float
) -> tuple[FloatArray, FloatArray]:
    """Acceleration and speed without noise, (row,), at the end of each row of `command`, from a start at `speed`."""
    pilot = Recorded(np.append(command, command[-1]), start_speed=speed)
    run = simulate(car.silent(), pilot, seconds=(len(command) + 1) / rate_hz, rate_hz=rate_hz, effects=effects)
    return run.accel[1:], run.speed[1:]


class SteppedVehicle:
    """The reference vehicle without noise, a millisecond at a time. `effects`: some of `OWN`."""

    def __init__(self, car: Car, effects: Effects) -> None:
        assert effects.keys() <= OWN, effects
        self.car, self.effects = car, effects

    def reset(self, *, speed: float, accel: float) -> None:
        """Begin in steady state."""
        push = forces(self.effects, lambda name: np.random.default_rng(0), reach=_FAR_M)
        from_actuator = accel - sum(force(speed, 0.0, 0.0) for force in push)
        self._push, self._actuate = push, actuator(self.car, self.effects, from_actuator)
        self._bus = Command(self.effects, lost=None, start=from_actuator / self.car.K_L)
        self._speed, self._total, self._position = speed, accel, 0.0
        self._row = self._millisecond = 0

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        """Hold a command for `dt` [s], a whole number of milliseconds; acceleration and speed at the end."""
        self._bus.send(self._row, self._millisecond * STEP_S, accel_cmd)
        self._row += 1
        accel = self._total
        for _ in range(round(dt / STEP_S)):
            time = self._millisecond * STEP_S
            ahead = self._actuate(self._bus.over(time), self._speed, time)
            expected = self._speed + STEP_S * self._total
            for force in self._push:
                ahead += force(expected, self._position, time + STEP_S)
            speed = max(self._speed + 0.5 * STEP_S * (self._total + ahead), 0.0)
            accel = ahead if speed > 0.0 else 0.0  # at rest a brake holds it
            self._position += 0.5 * STEP_S * (self._speed + speed)
            self._speed, self._total = speed, ahead
            self._millisecond += 1
        return accel, self._speed
