"""A plant as a chain of linear responses, for verdicts on stability and for how late it answers."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from avtorch.gap.effects.road_grade import RoadGrade
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.simulator_input import SimulatorInput
from avtorch.vehicle.stability import Chain, frequencies

_DT, _SECONDS, _BEFORE = 0.01, 30.0, 1.0
_LATE = 1e5  # [s], when every change of gain is over
_ASIDE = 0.5  # [m/s]


def linearised(
    plant: GapPlant, belief: Mapping[str, Tensor] | None = None, *, speed: float, step: float = 0.5
) -> Chain:
    """The chain of `plant` at `speed` [m/s] for steps of `step` [m/s²] (below 0: braking).

    `belief`: draws (draw,) of its parameters by the plant's names; without, its own values, and a batch of one. Drags
    and pushes are linearised at that speed, random effects and the road are left out.

    The responses come from simulating the plant, so any effect works, including a user's own. A step of the command
    gives the motion and the sensor's reading of it; runs at slightly higher and lower speed give the drop of
    acceleration with speed. A nonlinearity (a dead band, play, a limit) is represented by its response to a step of
    that size.
    """
    # the road is not a property of the car
    own = [e for e in plant.effects if not e.random and not isinstance(e, RoadGrade)]
    car = GapPlant(own, T_L=plant.T_L, K_L=plant.K_L, sigma=0.0)
    given = {k: v for k, v in (belief or {}).items() if k in car.parameters()}
    values = {k: torch.as_tensor(v, dtype=torch.float64).reshape(-1) for k, v in {**car.values(), **given}.items()}
    time = _LATE + _DT * torch.arange(round((_SECONDS + _BEFORE) / _DT), dtype=torch.float64)
    begin = round(_BEFORE / _DT)
    command = torch.zeros_like(time)
    command[begin:] = step

    def answer(u: Tensor, v: float) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            response = car.response(SimulatorInput(time, u, torch.full_like(time, v)), values)
        return response.accel, response.accel_measured

    rests, moves = answer(torch.zeros_like(command), speed), answer(command, speed)
    omega = frequencies(most=100.0)
    # linear between samples: the rate is piecewise constant, and its transform exact
    middle = _DT * (torch.arange(len(time) - begin, dtype=torch.float64) + 0.5) - _DT
    half = 0.5 * omega * _DT
    turn = torch.exp(-1j * middle[:, None] * omega) * (torch.sin(half) / half)
    motion, reading = (
        ((m - r).diff(dim=-1)[..., begin - 1 :] / step).to(torch.complex128) @ turn
        for m, r in zip(moves, rests, strict=True)
    )
    faster, slower = (answer(torch.zeros_like(command), speed + x)[0][..., -1] for x in (_ASIDE, -_ASIDE))
    drag = (slower - faster) / (2 * _ASIDE)
    count = max(len(v) for v in values.values())
    shape = (count, len(omega))
    motion, reading = motion.expand(shape), reading.expand(shape)
    small = motion.abs() < 1e-9
    sensed = torch.where(small, 0.0, reading / torch.where(small, 1.0, motion))
    return Chain(omega, motion, sensed, drag.expand(count))
