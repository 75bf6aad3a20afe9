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
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.order import at_place, substeps
from avtorch.gap.simulator.plant import GapPlant
from avtorch.gap.simulator.stepping import ROUNDS, SimulationState, begin, context_of, drawn_for
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
        past = begin(plant.effects, total, v, tensor(u), self._dt, T_L, K_L, plant.seed)
        seen, row = total, self._context(past, v)
        for e in at_place(past.effects, "sensor"):
            at = drawn_for(past, e, row, 0)
            seen = e.advance(seen, at, e.start(seen, at))[0]
        return replace(past, seen=seen, speed=v, seen_speed=v)

    def _next(self, past: SimulationState, accel: float, speed: float) -> SimulationState:
        """The forces at the speed that they lead to, by trapezoids, as `stepping.move` has them."""
        a, dt, memory = tensor(accel), self._dt, dict(past.memory)
        before, own = self._shown
        gained = speed - before
        v, force = tensor(own + gained) + dt * past.force, past.force
        bodies = at_place(past.effects, "body")
        for _ in range(ROUNDS if bodies else 0):
            force, after = torch.zeros_like(v), self._context(past, v)
            for e in bodies:
                y, memory[e.name] = e.advance(a, drawn_for(past, e, after, past.row), past.memory[e.name])
                force = force + y
            v = own + gained + 0.5 * dt * (past.force + force)
        position = past.position + 0.5 * dt * (own + v)
        after, seen = self._context(past, v), a + force
        for e in at_place(past.effects, "sensor"):
            seen, memory[e.name] = e.advance(seen, drawn_for(past, e, after, past.row), past.memory[e.name])
        shown = v
        for e in at_place(past.effects, "sensor", "speed"):
            shown, memory[e.name] = e.advance(shown, after, past.memory[e.name])
        return replace(past, seen=seen, seen_speed=shown, speed=v, position=position, force=force, memory=memory)

    def _context(self, past: SimulationState, v: Tensor) -> Any:
        moved = 0.5 * self._dt * (self._shown[1] + v) if past.row else torch.zeros_like(v)
        return context_of(past, past.time, v, past.position + moved, self._dt)

    def _command(self, past: SimulationState, u: Tensor) -> tuple[Tensor, dict[str, Any]]:
        memory: dict[str, Any] = {}
        row = context_of(past, past.time, past.speed, past.position, self._dt)

        def hook(e: Effect, x: Tensor) -> Any:
            y, memory[e.name] = e.advance(x, drawn_for(past, e, row, past.row), past.memory[e.name])
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
