"""Effects around another simulator, one step at a time: what acts before it on the command, and after it on its answer.

The other simulator is the actuator. Its acceleration stands where the plant's own actuator has its, so the plant's
`T_L` and `K_L` have no say. What effects do within the actuator can be said outside it only if it is a gain.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.gap.simulator.chain import (
    SimulationState,
    at_place,
    begin,
    context_of,
    drawn_for,
    end_of_step,
    substeps,
)
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant
from avtorch.vehicle.arguments import tensor

_COMMANDS, _SPEEDS = (-6.0, -1.0, 1.0, 3.0), (0.5, 5.0, 15.0, 35.0)  # m/s², m/s: where lags are looked for


class Around:
    """The effects of `plant` around a simulator that is stepped by `dt` [s].

    At each time: `command(u)` is what that simulator is to be given, `car(accel, speed)` is what the car shows where
    that simulator has `accel` [m/s²] and `speed` [m/s]. Both may be called any number of times; `advance` goes on to
    the next time. A late command that switches within a step is given as the step's mean.

    Raises InputError for effects that act within the actuator and are no gain, such as another lag.
    """

    def __init__(self, plant: GapPlant, dt: float) -> None:
        self._plant, self._dt = plant, dt
        self._past: SimulationState | None = None
        self._shown = (0.0, 0.0)  # of the other simulator and of the car: speeds at the last time
        self._checked()

    def command(self, u: float, accel: float, speed: float) -> float:
        """The command [m/s²] for the simulator until the next time, where it shows `accel` and `speed` now."""
        return float(self._command(self._at(u, accel, speed), tensor(u))[0])

    def car(self, u: float, accel: float, speed: float) -> tuple[float, float]:
        """The car's measured acceleration [m/s²] and speed [m/s] now."""
        past = self._at(u, accel, speed)
        return float(past.seen), float(past.seen_speed)

    def advance(self, u: float, accel: float, speed: float) -> None:
        """Go on to the next time, `u` held until then."""
        past = self._at(u, accel, speed)
        _, memory = self._command(past, tensor(u))
        self._shown = (speed, float(past.speed))
        self._past = replace(past, row=past.row + 1, time=past.time + self._dt, memory={**past.memory, **memory})

    def _at(self, u: float, accel: float, speed: float) -> SimulationState:
        """The state of this time; until `advance` nothing of it is kept."""
        with torch.no_grad():
            return self._first(u, accel, speed) if self._past is None else self._next(self._past, accel, speed)

    def _first(self, u: float, accel: float, speed: float) -> SimulationState:
        plant, a, v = self._plant, tensor(accel), tensor(speed)
        T_L, K_L = tensor(plant.T_L), tensor(plant.K_L)
        # `begin` takes the car's acceleration: the actuator's, and the forces at this speed
        total = a + begin(plant.effects, a, v, tensor(u), self._dt, T_L, K_L, plant.seed).force
        return begin(plant.effects, total, v, tensor(u), self._dt, T_L, K_L, plant.seed)

    def _next(self, past: SimulationState, accel: float, speed: float) -> SimulationState:
        before, own = (tensor(x) for x in self._shown)
        end = end_of_step(past, tensor(accel), own, speed - before, past.position, self._dt)
        return replace(end, position=past.position + 0.5 * self._dt * (own + end.speed))

    def _command(self, past: SimulationState, u: Tensor) -> tuple[Tensor, dict[str, Any]]:
        memory: dict[str, Any] = {}
        row = context_of(past, past.speed, past.position, self._dt)

        def hook(e: Effect, x: Tensor) -> Any:
            y, memory[e.name] = e.advance(x, drawn_for(past, e, row), past.memory[e.name])
            return y

        with torch.no_grad():
            parts = substeps(past.effects, u, row, hook)
            if any(bool((part.lag != past.T_L).any()) for part in parts):
                raise InputError("an effect changes the lag, which is within the simulator; needs a gain or none")
            given = sum((part.target * part.length for part in parts), torch.zeros_like(u))
        return given / (self._dt * past.K_L), memory

    def _checked(self) -> None:
        for e in at_place(self._plant.effects, "actuator"):
            alone = copy.copy(self)
            alone._plant = GapPlant([e], T_L=self._plant.T_L, K_L=self._plant.K_L, sigma=0.0)
            try:
                if e.actuator_parameters():
                    raise InputError
                for u in _COMMANDS:
                    for v in _SPEEDS:
                        alone.command(u, u, v)
            except InputError:
                raise InputError(
                    f"{e.name}: acts within the actuator, where no block around another simulator can act; needs the "
                    "whole car as a block, or the effect in that simulator"
                ) from None
