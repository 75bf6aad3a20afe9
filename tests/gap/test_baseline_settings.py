"""A simulator keeps the speeds that its parameters refer to, whatever the mean speed of the drive."""

import numpy as np
import pytest
import torch

from avtorch import diagnose
from avtorch.gap import DeadTime
from avtorch.gap.compare import compare
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain
from avtorch.gap.effects.speed_dependent_lag import SpeedDependentLag
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log
from tests.gap.cars import log_of

TIME = np.arange(1200) * 0.05
MEAN_SPEED = 25.0
NOISE = 0.05


def drive_of(simulator: GapPlant) -> Log:
    """A drive at `MEAN_SPEED` of a car that is exactly the simulator."""
    command = np.sin(0.9 * TIME) + 0.6 * np.sin(0.37 * TIME + 1)
    speed = torch.full((1200,), MEAN_SPEED, dtype=torch.float64)
    for _ in range(4):  # until speed is that of the response
        speed = simulator.response(SimulatorInput(torch.as_tensor(TIME), torch.as_tensor(command), speed)).speed
    response = simulator.response(SimulatorInput(torch.as_tensor(TIME), torch.as_tensor(command), speed))
    return Log.from_arrays(
        time=TIME, accel_cmd=command, accel=response.accel_measured.numpy(), speed=response.speed.numpy()
    )


def noisy(log: Log) -> Log:
    rng = np.random.default_rng(2)
    assert log.accel is not None
    assert log.speed is not None
    accel, speed = (x + NOISE * rng.standard_normal(log.rows) for x in (log.accel, log.speed))
    return Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=accel, speed=speed)


SIMULATORS = [
    plant([SpeedDependentGain(0.3, mean_speed=10.0)], T_L=0.4, K_L=0.9),
    plant([SpeedDependentLag(0.5, mean_speed=10.0)], T_L=0.4, K_L=0.9),
]


@pytest.mark.slow
@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda p: p.effects[0].name)
def test_a_diagnosis_keeps_them(simulator: GapPlant) -> None:
    found = diagnose(noisy(drive_of(simulator)), baseline=simulator, effects=["dead_time"], pairs=False)
    assert found.verdict.names == ("none",)
    assert found.simulator is not None
    assert found.simulator.effects[0].mean_speed == 10.0  # type: ignore[attr-defined]
    assert found.traces is not None
    left = found.traces.measured - found.traces.before
    # the sensors' noise; with another mean speed the gain would be off by a third
    assert np.sqrt((left[0] ** 2).mean()) == pytest.approx(NOISE, rel=0.2)


@pytest.mark.slow
def test_an_effect_that_it_lacks_is_around_the_drives_own_speed() -> None:
    log = noisy(drive_of(SIMULATORS[0]))
    found = diagnose(log, effects=["speed_dependent_gain"], prior={"unknown": 0.0}, pairs=False)
    (candidate,) = (c for c in found.candidates if c.name == "speed_dependent_gain")
    assert candidate.probability > 0
    if found.plant is not None:
        assert log.speed is not None
        (effect,) = (e for e in found.plant.effects if not e.random)
        assert effect.mean_speed == pytest.approx(log.speed.mean(), rel=0.02)  # type: ignore[attr-defined]


def test_a_comparison_keeps_them() -> None:
    car = SIMULATORS[0]
    log = drive_of(car)
    read = noisy(log)
    other = plant([SpeedDependentGain(0.3, mean_speed=MEAN_SPEED)], T_L=0.4, K_L=0.9)
    assert compare(read, read, baseline=other, baseline_after=car, effects=[]).simulator == "closer"


def test_what_a_baseline_lacks_is_found_where_the_compiled_plant_lacks_the_baseline() -> None:
    """A gain that changes is tried, too: its moment is in its own equation."""
    log = log_of([SpeedDependentGain(0.3, 12.0), DeadTime(0.3)], seed=12, seconds=75.0)
    baseline = plant([SpeedDependentGain(0.3, 12.0)])
    found = diagnose(log, baseline=baseline, effects=["dead_time", "gain_change"], pairs=False)
    assert "dead_time" in found.verdict.names
