"""Cars of the callers' examples: drives of the blind test's reference vehicle, and a simulator as a user writes one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from avtorch import Leader, LinearController, Log
from avtorch import simulate as follow
from avtorch.gap import plant
from benchmarks.blindtest import Car, DrivePlan, Recorded, simulate

RATE_HZ = 25
CAR = Car(T_L=0.3, K_L=0.95)
Effects = Mapping[str, Mapping[str, float]]
Manoeuvre = Literal["cruise", "following", "stop_and_go", "steps"]
LATE: Effects = {"dead_time": {"delay_s": 0.25}}
DRAGGED: Effects = {"constant_resistance": {"resistance_mps2": 0.3}}
TILTED: Effects = {"sensor_bias": {"bias_mps2": 0.25}}
DEAF: Effects = {"dead_band": {"half_width_mps2": 0.2}}
BRAKED_BY_AIR: Effects = {
    "aerodynamic_drag": {"drag_per_m": 4e-4, "wind_mps": 0.0, "wind_swing_mps": 0.0, "wind_period_s": 60.0}
}
OWN: Effects = {
    "second_order_actuator": {"natural_frequency_radps": 6.0, "damping_ratio": 0.8},
    "dead_time": {"delay_s": 0.12},
}
"""What a user's simulator has of its own."""


def drive(
    name: str, effects: Effects, *, seed: int, seconds: float = 60.0, car: Car = CAR, manoeuvre: Manoeuvre = "steps"
) -> Log:
    """The car's log, on command steps unless another manoeuvre is asked for."""
    pilot = DrivePlan(manoeuvre, seconds=seconds, rate_hz=RATE_HZ, seed=seed).pilot()
    run = simulate(car, pilot, seconds=seconds, rate_hz=RATE_HZ, effects=effects, seed=seed)
    return Log.from_arrays(name=name, time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


def output(command: ArrayLike, start_speed: float) -> Log:
    """The output of a simulator with `OWN` effects under these commands."""
    sent = np.asarray(command, float)
    pilot = Recorded(sent, start_speed=start_speed)
    run = simulate(CAR.silent(), pilot, seconds=len(sent) / RATE_HZ, rate_hz=RATE_HZ, effects=OWN)
    return Log.from_arrays(name="simulator", time=run.time, accel_cmd=sent, accel=run.accel, speed=run.speed)


def behind_a_leader() -> Log:
    """Ninety seconds of a car that follows, whose commands act 0.4 s late."""
    late = plant(baseline="dead_time=0.4", T_L=0.3, sigma=0.02)
    law = LinearController(gains=(0.2, 0.6, 0.0), time_gap=1.5)
    return follow(Leader.default(start=50.0, duration=90.0, dt=0.1), law, plant=late, seeds=3).log()


@dataclass
class Lag:
    """A simulator: a first-order lag [s]."""

    lag: float = 0.3
    speed: float = field(default=0.0, init=False)
    accel: float = field(default=0.0, init=False)

    def reset(self, *, speed: float, accel: float) -> None:
        self.speed, self.accel = speed, accel

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        before = self.accel
        self.accel = accel_cmd + exp(-dt / self.lag) * (before - accel_cmd)
        self.speed = max(self.speed + dt * (before + self.accel) / 2, 0.0)
        return self.accel, self.speed
