"""One command for all tests: steps, ramps and sines, and the closed loop run open on it."""

from __future__ import annotations

import math

import torch

from avtorch.gap import Effect, GapPlant, SimulatorInput
from avtorch.vehicle import Block, ClosedLoop, FollowerState, Leader
from avtorch.vehicle.plant import Plant

DT = 0.02


def command_at(time: float) -> float:
    """[m/s²] a demand with steps, reversals and quiet parts."""
    steps = (0.9, -0.5, 0.4)[int(time / 3.0) % 3]
    return steps + 0.8 * math.sin(0.9 * time) + 0.3 * math.sin(4.0 * time)


def driven(plant: Plant, *, seconds: float = 9.0, speed0: float = 12.0, scenarios: int = 1) -> Block:
    """The open loop: rows (scenario, time), the controller blind."""
    time = torch.arange(round(seconds / DT) + 1, dtype=torch.float64) * DT
    leader = Leader(time, 25 * time, torch.full_like(time, 25.0), torch.zeros_like(time), DT)

    def blind(state: FollowerState) -> torch.Tensor:
        return torch.full_like(state.speed, command_at(state.time))

    loop = ClosedLoop(leader, blind, plant=plant, speed0=speed0, spacing0=1e6, scenarios=scenarios)
    return loop.advance(len(time) - 1)


def drive_of(block: Block, scenario: int = 0) -> SimulatorInput:
    """The same drive, as a log would hold it."""
    return SimulatorInput(block.time, block.accel_cmd[scenario], block.speed[scenario], 0.0)


def smooth_drive(rows: int = 80, dt: float = 0.05) -> SimulatorInput:
    """A short drive, its speed crossing the first shift speeds."""
    time = torch.arange(rows, dtype=torch.float64) * dt
    command = 1.1 + 1.3 * torch.sin(1.9 * time) + 0.2 * torch.cos(7.0 * time)
    speed = 3.0 + 1.2 * time + 0.3 * torch.sin(1.3 * time)
    return SimulatorInput(time, command, speed, 0.2)


def filled(plant: GapPlant) -> GapPlant:
    """The plant with the slope's profile drawn, as a simulation draws it."""
    effects: list[Effect] = [e.drawn(torch.Generator().manual_seed(5)) for e in plant.effects]
    return GapPlant(effects, T_L=plant.T_L, K_L=plant.K_L, sigma=plant.sigma, seed=plant.seed)
