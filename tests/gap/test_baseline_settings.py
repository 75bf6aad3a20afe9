"""A simulator keeps the speeds that its parameters refer to, whatever the mean speed of the drive."""

import numpy as np
import pytest
import torch

from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.effect_model import EffectModel
from avtorch.gap.compare import compare
from avtorch.gap.drive_record import Record
from avtorch.gap.effects.speed_dependent_gain import SpeedDependentGain
from avtorch.gap.effects.speed_dependent_lag import SpeedDependentLag
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.io import Log

TIME = np.arange(1200) * 0.05
MEAN_SPEED = 25.0


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


SIMULATORS = [
    plant([SpeedDependentGain(0.3, mean_speed=10.0)], T_L=0.4, K_L=0.9),
    plant([SpeedDependentLag(0.5, mean_speed=10.0)], T_L=0.4, K_L=0.9),
]


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda p: p.effects[0].name)
def test_the_likelihood_keeps_them(simulator: GapPlant) -> None:
    record = Record.of(drive_of(simulator))
    bare = Hypothesis(record, (), simulator)
    errors = record.measured - np.stack(
        [
            record.at_counted_rows([getattr(bare.plant.response(d), name) for d in record.drives])
            for name in ("accel_measured", "speed")
        ]
    )
    assert np.abs(errors[0]).max() < 1e-3  # the speeds that act are smoothed readings


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda p: p.effects[0].name)
def test_the_budget_keeps_them(simulator: GapPlant) -> None:
    record = AnalysisRecord.of([drive_of(simulator)])
    bare = EffectModel(record, simulator)
    z = bare.coordinates(
        {
            key: bare.plant.parameters()[key].unconstrain(torch.tensor(value)).numpy()
            for key, value in (("T_L", 0.4), ("K_L", 0.9))
        }
    )
    errors = (record.measured - bare.simulate(z))[:, record.counts]
    # commands are averaged over rows of 50 ms here
    assert np.sqrt((errors**2).mean()) < 0.01 * record.measured[:, record.counts].std()


def test_a_comparison_keeps_them() -> None:
    car = SIMULATORS[0]
    log = drive_of(car)
    rng = np.random.default_rng(2)
    noisy = Log.from_arrays(
        time=log.time,
        accel_cmd=log.accel_cmd,
        accel=log.accel + 0.05 * rng.standard_normal(log.rows),
        speed=log.speed + 0.05 * rng.standard_normal(log.rows),
    )
    other = plant([SpeedDependentGain(0.3, mean_speed=MEAN_SPEED)], T_L=0.4, K_L=0.9)
    assert compare(noisy, noisy, baseline=other, baseline_after=car, effects=[]).simulator == "closer"


@pytest.mark.parametrize("simulator", SIMULATORS, ids=lambda p: p.effects[0].name)
def test_an_effect_that_is_fitted_anew_keeps_them_too(simulator: GapPlant) -> None:
    """So that its slope and `K_L` can be laid beside the simulator's."""
    log, kind = drive_of(simulator), type(simulator.effects[0])
    budget, likelihood = (
        EffectModel(AnalysisRecord.of([log]), simulator, (kind,)),
        Hypothesis(Record.of(log), (kind,), simulator),
    )
    for fitted in (budget.plant, likelihood.plant):
        assert fitted.effects[0].mean_speed == 10.0  # type: ignore[attr-defined]
    lacking = EffectModel(AnalysisRecord.of([log]), plant([]), (kind,)).plant
    assert log.speed is not None
    assert lacking.effects[0].mean_speed == pytest.approx(log.speed.mean(), rel=0.01)  # type: ignore[attr-defined]
