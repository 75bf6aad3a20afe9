"""A simulator and a car that share no equation with the diagnosis: the blind test's reference vehicle, every ms."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from avtorch.io import Log
from benchmarks.blindtest import Car, DrivePlan, Recorded, simulate

OWN: dict[str, dict[str, float]] = {
    "second_order_actuator": {"natural_frequency_radps": 6.0, "damping_ratio": 0.8},
    "speed_dependent_gain": {"gain_slope": 0.2, "reference_speed_mps": 15.0},
    "aerodynamic_drag": {"drag_per_m": 4e-4, "wind_mps": 0.0, "wind_swing_mps": 0.0, "wind_period_s": 60.0},
    "dead_time": {"delay_s": 0.12},
}
"""What the simulator has of its own."""
CAR = Car(T_L=0.3, K_L=0.95)


def drive(
    seed: int,
    *,
    manoeuvre: str = "steps",
    seconds: float = 90.0,
    more: Mapping[str, Mapping[str, float]] | None = None,
    changed: Mapping[str, Mapping[str, float]] | None = None,
) -> tuple[Log, Log]:
    """A car's log, and the simulator's output under the same commands. The car is the simulator with `more` effects
    and with parameters `changed`, and has noise."""
    effects: dict[str, dict[str, float]] = {name: dict(values) for name, values in OWN.items()}
    for name, values in (changed or {}).items():
        effects[name] |= values
    effects |= {name: dict(values) for name, values in (more or {}).items()}
    pilot = DrivePlan(manoeuvre, seconds=seconds, rate_hz=50, seed=seed).pilot()
    run = simulate(CAR, pilot, seconds=seconds, rate_hz=50, effects=effects, seed=seed)
    return _log(run, "car.csv"), output(run.command, float(run.speed[0]))


def output(command: Any, start_speed: float) -> Log:
    """The simulator's output under these commands."""
    pilot = Recorded(command, start_speed=start_speed)
    run = simulate(CAR.silent(), pilot, seconds=len(command) / 50, rate_hz=50, effects=OWN)
    return _log(run, "simulator.csv")


def _log(run: Any, name: str) -> Log:
    return Log.from_arrays(
        name=name, time=run.time, accel_cmd=run.command, accel=run.accel, speed=np.maximum(run.speed, 0.0)
    )
