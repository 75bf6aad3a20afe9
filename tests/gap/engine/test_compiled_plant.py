"""The compiled plant is the simulator: every effect alone and beside every other one."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
import torch

from avtorch import Log
from avtorch.gap import AerodynamicDrag, DrivelineOscillation, Effect, SecondOrderActuator, plant
from avtorch.gap.engine import hypothesis
from avtorch.gap.engine.coordinates import EFFECTS, FROM_THE_START, INDEX
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.simulator.simulator_input import SimulatorInput

VALUES = {
    "dead_time": (0.217,),
    "dead_band": (0.11,),
    "backlash": (0.07,),
    "hand_over": (0.31,),
    "saturation": (1 / 1.1, 1 / 1.3),
    "brake_throttle_asymmetry": (-0.35, 0.5),
    "second_order_actuator": (0.04,),
    "rate_limit": (1 / 0.9, -0.4),
    "speed_dependent_lag": (0.5,),
    "speed_dependent_gain": (-0.3,),
    "gain_change": (-0.25, math.log(4.3)),
    "gear_shift": (0.7, 0.31),
    "driveline_oscillation": (0.2, 2.3, 0.12),
    "aerodynamic_drag": (4e-4, 2.0),
    "viscous_drag": (0.013,),
    "constant_resistance": (0.12,),
    "low_speed_creep": (0.4, 2.2),
    "sensor_lag": (0.23,),
    "sensor_bias": (-0.1,),
    "sensor_scale": (0.12,),
    "speed_lag": (0.31,),
}
PAIRS = list(combinations(VALUES, 2))


def _data(seed: int) -> DriveData:
    """Thirty seconds whose commands and speeds reach every effect."""
    random = np.random.default_rng(seed)
    time = np.arange(0.0, 30.0, 0.02)
    command = 1.5 * np.sin(2 * np.pi * time / 9) + np.repeat(random.normal(0, 0.4, 60), 25)
    speed = 6.0 + 5.0 * np.sin(2 * np.pi * time / 20) + 0.2 * np.sin(2 * np.pi * time / 3)
    accel = np.gradient(speed, time)
    return DriveData.of(Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speed))


def _hypothesis(effects: tuple[str, ...]) -> Hypothesis:
    h = Hypothesis(_data(len(effects)), shift_speeds=np.array([3.0, 5.5, 8.0]))
    h["T_L"], h["K_L"] = 0.37, 0.93
    for e in effects:
        onset = float(h.data.time[700]) if EFFECTS[e].onset == "must" else None
        h = h.with_effect(e, VALUES[e], onset)
    return h


def _by_the_simulator(h: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    grid = h.data.grid
    drive = SimulatorInput(
        torch.as_tensor(grid.time),
        torch.as_tensor(h.data.command[grid.row]),
        torch.as_tensor(grid.speed),
        float(grid.accel0[0]),
    )
    response = hypothesis.plant_of(h).response(drive)
    return response.accel_measured.numpy(), (response.speed_measured - response.speed_measured[0]).numpy()


@pytest.mark.parametrize("effects", [(), *[(e,) for e in VALUES]], ids="+".join)
def test_an_effect_acts_as_in_the_simulator(effects):
    h = _hypothesis(effects)
    for compiled, torch_ in zip(h.on_grid(), _by_the_simulator(h), strict=True):
        # the same formulas in another order of operations
        np.testing.assert_allclose(compiled, torch_, rtol=0, atol=1e-9)


def test_two_effects_act_as_in_the_simulator():
    for effects in PAIRS:
        h = _hypothesis(effects)
        for compiled, torch_ in zip(h.on_grid(), _by_the_simulator(h), strict=True):
            np.testing.assert_allclose(compiled, torch_, rtol=0, atol=1e-9, err_msg="+".join(effects))


def test_a_gain_that_has_always_been_changed_is_another_gain():
    h = _hypothesis(("gain_change",))
    values, onsets = h.values.copy(), np.full(len(h.values), FROM_THE_START)
    values[INDEX["gain_step"]] = -0.3
    other = h.values.copy()
    other[INDEX["gain_step"]] = 0.0
    other[INDEX["K_L"]] *= 0.7
    for changed, plain in zip(h.on_grid(values, onsets), h.on_grid(other, onsets), strict=True):
        assert np.abs(changed - plain).max() < 1e-9


@pytest.mark.parametrize(
    "effect",
    [
        DrivelineOscillation(2.2, 0.3),
        DrivelineOscillation(2.2, 0.3, quadrature=0.2),
        DrivelineOscillation(2.2, 0.3, mode_damping=0.2),
        SecondOrderActuator(0.2, lag_ratio=0.5),
        AerodynamicDrag(4e-4, 3.0),
    ],
    ids=repr,
)
def test_a_users_baseline_has_all_its_settings(effect: Effect):
    simulator = plant([effect], T_L=0.37, K_L=0.93)
    own = None if hypothesis.compiled(simulator) else simulator
    h = Hypothesis(_data(1), neutral=hypothesis.neutral_of(simulator), baseline=own)
    h.values = h.neutral.copy()
    grid = h.data.grid
    drive = SimulatorInput(
        torch.as_tensor(grid.time),
        torch.as_tensor(h.data.command[grid.row]),
        torch.as_tensor(grid.speed),
        float(grid.accel0[0]),
    )
    np.testing.assert_allclose(h.on_grid()[0], simulator.response(drive).accel_measured.numpy(), atol=1e-9)


def test_a_ring_begins_at_rest() -> None:
    """The car does not jump where a ring sets in."""
    h = Hypothesis(_data(1))
    onset = float(h.data.time[700])
    grid = h.data.grid.time
    change = h.with_effect("driveline_oscillation", (2.0, 2.3, 0.05), onset).on_grid()[0] - h.on_grid()[0]
    first = int(np.searchsorted(grid, onset))
    assert (change[: first + 1] == 0).all()
    assert np.abs(change[first + 1 :]).max() > 0.1
