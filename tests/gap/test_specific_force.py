"""An accelerometer measures every force but gravity: on hills it differs from the speed, which identifies slopes.

The reference vehicle gives the log. Its actuator does not depend on the speed, so under the same commands and noise an
accelerometer reads the same on hills as on the flat.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import avtorch
from avtorch.errors import InputError
from avtorch.gap import AerodynamicDrag, RoadGrade, SensorLag, SimulatorInput, plant
from avtorch.gap.result.counted_rows import CountedRows
from avtorch.io import Log
from benchmarks.blindtest.car import Car
from benchmarks.blindtest.drives import DrivePlan as Plan
from benchmarks.blindtest.drives import Recorded
from benchmarks.blindtest.vehicle import Run, simulate
from tests.gap.records import log_of

D = torch.float64


def drive(grade_rms: float, seed: int) -> Log:
    """90 s of steps at 14 to 31 m/s over slopes of this RMS, the accelerometer fixed to the car."""
    car, plan = Car(T_L=0.4, K_L=0.95, process_sd=0.04), Plan("steps", 90.0, 20, seed)
    command = simulate(car, plan.pilot(), seconds=90.0, rate_hz=20, seed=seed).command

    def again(effects: dict[str, dict[str, float]]) -> Run:
        pilot = Recorded(command, start_speed=plan.pilot().start_speed + 5)
        return simulate(car, pilot, seconds=90.0, rate_hz=20, effects=effects, seed=seed)

    flat, hilly = again({}), again({"road_grade": {"grade_rms": grade_rms, "length_m": 150.0}} if grade_rms else {})
    return Log.from_arrays(time=hilly.time, accel_cmd=hilly.command, accel=flat.accel, speed=hilly.speed)


@pytest.mark.slow
def test_hills_are_named_where_the_log_declares_specific_force() -> None:
    hills, flat = drive(0.02, 1), drive(0.0, 1)
    told = avtorch.diagnose(hills, accel_kind="specific-force")
    assert told.verdict.names == ("road_grade",)
    # taken for dv/dt, the same reading contradicts the speed, and no slope explains that
    assert "road_grade" not in avtorch.diagnose(hills, accel_kind="kinematic").verdict.names
    assert avtorch.diagnose(flat, accel_kind="specific-force").verdict.names == ("none",)


def test_a_drive_with_an_accelerometer_shows_the_slope_in_the_speed_alone() -> None:
    road = RoadGrade(0.04, torch.linspace(-1, 1, 8, dtype=D), 8)
    car, flat = plant([road, AerodynamicDrag(), SensorLag(0.2)]), plant([AerodynamicDrag(), SensorLag(0.2)])
    time = torch.arange(200, dtype=D) * 0.05
    drive = SimulatorInput(time, torch.sin(time), 20 + torch.sin(time), 0.3)
    bus, fixed = car.response(drive), car.response(replace(drive, specific_force=True))
    level = flat.response(drive)
    # the drag is felt, the slope is not; the start is the actuator's own in both, gravity in it or not
    torch.testing.assert_close(fixed.accel_measured, level.accel_measured, rtol=0, atol=1e-12)
    assert float((bus.accel_measured - level.accel_measured).abs().max()) > 0.1
    assert float((fixed.speed - level.speed).abs().max()) > 0.5
    late = torch.arange(200) > 100  # what the start differs by is forgotten
    torch.testing.assert_close(fixed.accel[late], bus.accel[late], rtol=0, atol=1e-3)


def test_the_kind_travels_with_the_log() -> None:
    log = replace(log_of(seconds=20.0, rate_hz=40), accel_kind="specific-force")
    assert log[0:100].accel_kind == "specific-force"
    assert all(d.specific_force for d in CountedRows.of(log).drives)
    with pytest.raises(InputError, match="different kinds of accel"):
        CountedRows.of([log, replace(log, accel_kind="kinematic")])
