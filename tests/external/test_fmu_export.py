"""Plants as FMUs: driven by another importer's rules, they answer as the plant does over a whole drive."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import fmpy
import numpy as np
import pytest
import torch

from avtorch import InputError
from avtorch.external import FmuSimulator, write_fmu
from avtorch.gap import (
    AerodynamicDrag,
    DeadTime,
    Effect,
    GapPlant,
    Gust,
    Outliers,
    Parameter,
    RateLimit,
    SecondOrderActuator,
    SensorBias,
    SensorLag,
    SimulatorInput,
    plant,
)
from avtorch.gap.simulator.around import Around

DT, ROWS = 0.05, 120
TIME = np.arange(ROWS) * DT
COMMAND = np.sin(1.3 * TIME) + 0.6 * np.sign(np.sin(3.1 * TIME))


def response(car: GapPlant, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Measured acceleration and speed at the ends of the steps, over the whole drive at this speed (row,)."""
    drive = SimulatorInput(torch.tensor(TIME), torch.tensor(COMMAND), torch.tensor(speed), accel0=0.3)
    found = car.response(drive)
    return found.accel_measured[1:].numpy(), found.speed[1:].numpy()


@pytest.mark.slow
@pytest.mark.parametrize(
    "effects",
    [
        [DeadTime(0.13), SensorLag(0.2), SensorBias(0.1), AerodynamicDrag(4e-4)],
        [SecondOrderActuator(), RateLimit(4.0)],
    ],
    ids=["chain", "actuator"],
)
def test_the_whole_car_is_the_plant(effects: Sequence[Effect], tmp_path: Path) -> None:
    car = plant(effects, K_L=0.8)
    with FmuSimulator(write_fmu(car, tmp_path / "car.fmu")) as fmu:
        accel, speed = fmu.whole_drive(COMMAND, DT, speed=20.0, accel=0.3)
        slow_accel, slow_speed = fmu.with_parameters({"K_L": 0.5}).whole_drive(COMMAND, DT, speed=20.0, accel=0.3)
        assert {name: fmu.parameters()[name] for name in car.values()} == {k: float(v) for k, v in car.values().items()}
    for one, a, v in ((car, accel, speed), (car.with_values({"K_L": 0.5}), slow_accel, slow_speed)):
        expected_accel, expected_speed = response(one, np.concatenate([[20.0], v[:-1]]))
        # each row adds a few roundings of numbers of the size of the speed
        close = {"rtol": 0.0, "atol": 8 * ROWS * 2.0**-52 * v.max()}
        np.testing.assert_allclose(a[:-1], expected_accel, **close)
        np.testing.assert_allclose(v[:-1], expected_speed, **close)


def test_its_description_keeps_the_standard_and_states_units(tmp_path: Path) -> None:
    for around in (False, True):
        path = write_fmu(plant([DeadTime(0.1)]), tmp_path / "car.fmu", around=around, dt=DT if around else None)
        found = fmpy.read_model_description(str(path), validate=True, validate_model_structure=True)
        units = {v.name: v.unit for v in found.modelVariables}
        assert units["accel_cmd"] == units["accel"] == "m/s2"
        assert (units["speed"], units["dead_time.delay_s"]) == ("m/s", "s")
        assert found.coSimulation.canHandleVariableCommunicationStepSize is not around
        assert {unit.name for unit in found.unitDefinitions} >= {"m/s2", "m/s", "s"}


@pytest.mark.slow
def test_a_car_that_stops_does_not_roll_back(tmp_path: Path) -> None:
    with FmuSimulator(write_fmu(plant(T_L=0.3), tmp_path / "car.fmu")) as car:
        _, speed = car.whole_drive(np.repeat([-3.0, 2.0], 60), DT, speed=2.0, accel=0.0)
    assert speed[:60].min() == 0.0 == speed.min()
    assert speed[-1] > 3.0


@pytest.mark.slow
def test_random_effects_are_drawn_by_the_seed(tmp_path: Path) -> None:
    with FmuSimulator(write_fmu(plant([Gust]), tmp_path / "car.fmu")) as car:
        one, other = (car.with_parameters({"seed": seed}) for seed in (1, 2))
        drives = [fmu.whole_drive(COMMAND[:20], DT, speed=20.0, accel=0.3)[1].tolist() for fmu in (one, one, other)]
    assert drives[0] == drives[1] != drives[2]


# around another simulator ------------------------------------------------------------------------------------------
# a master as another tool has it, in its own process: PythonFMU ends the interpreter that it has run in
_MASTER = """
import json, math, os, sys
import fmpy
from fmpy.fmi2 import FMU2Slave
path, folder, dt, lag, gain, commands = json.loads(sys.argv[1])
found = fmpy.read_model_description(path)
at = {v.name: v.valueReference for v in found.modelVariables}
fmu = FMU2Slave(guid=found.guid, unzipDirectory=fmpy.extract(path, folder), instanceName="block",
                modelIdentifier=found.coSimulation.modelIdentifier)
def put(**values):
    for name, x in values.items():
        fmu.setReal([at[name]], [x])
def get(*names):
    return [fmu.getReal([at[name]])[0] for name in names]
accel, speed, rows = commands[0], 20.0, []
fmu.instantiate()
fmu.setupExperiment(startTime=0.0)
fmu.enterInitializationMode()
put(accel_cmd=commands[0], accel_sim=accel, speed_sim=speed)
fmu.exitInitializationMode()
for k, u in enumerate(commands):
    put(accel_cmd=u)
    rows.append(get("accel", "speed"))
    given, = get("accel_cmd_out")
    # the user's simulator: first order, integrated exactly
    share = math.exp(-dt / lag)
    speed += gain * given * dt + (accel - gain * given) * lag * (1 - share)
    accel = gain * given + (accel - gain * given) * share
    fmu.doStep(k * dt, dt)
    put(accel_sim=accel, speed_sim=speed)
try:
    fmu.doStep(len(commands) * dt, 2 * dt)
    refused = False
except Exception:
    refused = True
print(json.dumps([rows, refused]), flush=True)
os._exit(0)
"""


@pytest.mark.slow
def test_around_a_simulator_the_whole_is_the_plant(tmp_path: Path) -> None:
    lag, gain = 0.4, 0.7
    car = plant([DeadTime(0.1), AerodynamicDrag(4e-4), SensorBias(0.1)], T_L=lag, K_L=gain)
    # the plant's own actuator has no say in the block
    path = write_fmu(car.with_values({"T_L": 9.0, "K_L": 2.0}), tmp_path / "around.fmu", around=True, dt=DT)
    given = json.dumps([str(path), str(tmp_path / "unpacked"), DT, lag, gain, COMMAND.tolist()])
    done = subprocess.run([sys.executable, "-c", _MASTER, given], capture_output=True, text=True, check=True)
    rows, refused = json.loads(done.stdout.splitlines()[-1])
    assert refused, "a step of another length is an error"
    accel, speed = np.array(rows).T
    start = Around(plant(car.effects[:-1]), DT).car(COMMAND[0], COMMAND[0], speed[0])[0]  # without the sensor
    drive = SimulatorInput(torch.tensor(TIME), torch.tensor(COMMAND), torch.tensor(speed), start)
    expected = car.response(drive)
    close = {"rtol": 0.0, "atol": 8 * ROWS * 2.0**-52 * speed.max()}
    np.testing.assert_allclose(accel, expected.accel_measured.numpy(), **close)
    np.testing.assert_allclose(speed, expected.speed.numpy(), **close)


# what cannot be written --------------------------------------------------------------------------------------------
class Unregistered(Effect):
    """An effect of the user's own, of which an FMU on another machine knows nothing."""

    name, place, meaning, equation = "unregistered", "sensor", "a test", "x"
    parameters = (Parameter("size", "-", 0.0, 0.1, 0.5),)
    size = 0.1


@pytest.mark.parametrize(
    ("found", "given", "text"),
    [
        (SimpleNamespace(plant=None), {}, "the diagnosis found no effect"),
        (plant(), {"around": True}, "dt: found None, needs the step"),
        (plant(), {"around": True, "dt": math.nan}, "dt: found nan"),
        (plant(), {"dt": 0.1}, "dt: found 0.1, needs none"),
        (plant([SecondOrderActuator]), {"around": True, "dt": 0.1}, "second_order_actuator: acts within the actuator"),
        (plant(T_L=torch.tensor([0.3, 0.4])), {}, r"T_L: found shape \(2,\)|T_L: .* number"),
        (GapPlant([Unregistered()], T_L=0.3, K_L=1.0, sigma=0.1), {}, "unregistered"),
    ],
)
def test_what_no_fmu_can_hold_is_refused(found: Any, given: dict, text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=text):
        write_fmu(found, tmp_path / "car.fmu", **given)
    assert not list(tmp_path.iterdir())


def test_a_diagnosis_gives_its_plant(tmp_path: Path) -> None:
    write_fmu(cast(Any, SimpleNamespace(plant=plant([Outliers]))), tmp_path / "car.fmu")
    with FmuSimulator(tmp_path / "car.fmu") as car:
        assert any(name.startswith("outliers.") for name in car.parameters())


def test_the_interpreter_is_left_as_it_was(tmp_path: Path) -> None:
    path, modules = list(sys.path), set(sys.modules)
    write_fmu(plant(), tmp_path / "car.fmu")
    assert sys.path == path
    assert not [name for name in set(sys.modules) - modules if "script" in name]


def test_what_is_not_installed_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pythonfmu.builder", None)
    with pytest.raises(InputError, match=re.escape("pip install 'avtorch[fmu]'")):
        write_fmu(plant(), tmp_path / "car.fmu")
