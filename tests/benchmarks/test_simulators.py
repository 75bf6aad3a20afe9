"""The reference vehicle as a simulator of a user's: by the step and as an FMU it is the one that drove the car."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avtorch.external import FmuSimulator
from benchmarks.blindtest import Car
from benchmarks.simulators.cases import WAYS
from benchmarks.simulators.fmu import write_fmu
from benchmarks.simulators.vehicle import OWN, SteppedVehicle, whole_drive

RATE_HZ, START = 50, 20.0
CAR = Car(T_L=0.3, K_L=0.95)
EFFECTS = {
    "dead_time": {"delay_s": 0.13},
    "second_order_actuator": {"natural_frequency_radps": 6.0, "damping_ratio": 0.8},
    "speed_dependent_gain": {"gain_slope": 0.2, "reference_speed_mps": 18.0},
    "aerodynamic_drag": {"drag_per_m": 4e-4, "wind_mps": 0.0, "wind_swing_mps": 0.0, "wind_period_s": 60.0},
}


@pytest.mark.slow
def test_the_stepped_vehicle_is_the_one_that_drives_the_cars(tmp_path: Path) -> None:
    assert EFFECTS.keys() == OWN
    command = np.where(np.arange(400) // 80 % 2 == 0, 1.0, -1.5)  # one stop from 20 m/s is not reached
    accel, speed = whole_drive(CAR, EFFECTS, command, RATE_HZ, speed=START)
    # an actuator at rest: the drag alone
    drag = -EFFECTS["aerodynamic_drag"]["drag_per_m"] * START**2
    vehicle = SteppedVehicle(CAR, EFFECTS)
    vehicle.reset(speed=START, accel=drag)
    stepped = np.array([vehicle.step(u, 1 / RATE_HZ) for u in command.tolist()]).T
    assert stepped[0] == pytest.approx(accel, abs=1e-4)  # drag of the first millisecond
    assert stepped[1] == pytest.approx(speed, abs=1e-3)
    with FmuSimulator(write_fmu(vehicle, tmp_path / "vehicle.fmu", 1 / RATE_HZ)) as fmu:
        fmu.reset(speed=START, accel=drag)
        driven = np.array([fmu.step(u, 1 / RATE_HZ) for u in command.tolist()]).T
    assert driven == pytest.approx(stepped, abs=1e-12)


def test_it_begins_in_steady_state() -> None:
    vehicle = SteppedVehicle(CAR, {name: EFFECTS[name] for name in ("second_order_actuator", "aerodynamic_drag")})
    vehicle.reset(speed=START, accel=0.5)
    command = (0.5 + 4e-4 * START**2) / CAR.K_L
    accel, speed = vehicle.step(command, 0.1)
    assert accel == pytest.approx(0.5, abs=2e-3)  # drag at 0.05 m/s more
    assert speed == pytest.approx(START + 0.05, abs=1e-3)


def test_same_verdicts_are_counted_by_case() -> None:
    from benchmarks.simulators.__main__ import table

    def row(number: int, by: str, missing: list[str]) -> dict:
        right = dict.fromkeys(("right", "nothing_else", "right_kind", "in_alias_set"), not missing)
        kind = {"kind": "none", "answered_kind": "effect" if missing else "none"}
        return {"number": number, "by": by, "missing": missing, "wrong": [], "seconds": 1.0, **kind, **right}

    rows = [row(0, "output", []), row(1, "output", ["gust"]), row(0, "fmu", []), row(1, "fmu", []), row(2, "fmu", [])]
    assert set(WAYS) >= {row["by"] for row in rows}
    lines = list(table(rows))
    assert any(line.startswith("output and fmu: same verdict 1 of 2") for line in lines)
    assert any(line.startswith("output, none parameter effect: right 1 of 2") for line in lines)
