"""Parts of a drive that are kept between rollouts from one onset."""

from __future__ import annotations

import torch

from avtorch.gap import AerodynamicDrag, SimulatorInput, plant
from avtorch.gap.simulator.rollout_from_onset import rollout_from_onset
from avtorch.gap.simulator.simulator_input import Place

D = torch.float64


def test_derivatives_flow_where_a_rollout_without_any_came_before() -> None:
    time = torch.arange(400, dtype=D) * 0.05
    drive = SimulatorInput(time, torch.sin(time), speed=20 + 0.1 * time)
    car, bare, place = plant([AerodynamicDrag()]), plant([]), Place(0, 100)
    one = torch.ones(1, dtype=D)
    with torch.inference_mode():
        (plain,) = rollout_from_onset(car, bare, [drive], {"T_L": 0.3 * one, "K_L": one}, place)
    lag = (0.3 * one).requires_grad_()
    (response,) = rollout_from_onset(car, bare, [drive], {"T_L": lag, "K_L": one}, place)
    torch.testing.assert_close(response.speed.detach(), plain.speed.clone(), rtol=1e-12, atol=0)
    (slope,) = torch.autograd.grad(response.accel.square().sum(), lag)
    assert float(slope) != 0


def test_the_last_cut_is_of_the_row_asked_for() -> None:
    time = torch.arange(50, dtype=D) * 0.05
    drive = SimulatorInput(time, time, speed=10 + time, position0=3.0)
    for row in (20, 20, 30, 20):
        until, since = drive.cut(row)
        assert (len(until.time), len(since.time)) == (row + 1, 50 - row)
        assert drive.position is not None
        assert since.position is not None
        torch.testing.assert_close(since.position, drive.position[row:])
