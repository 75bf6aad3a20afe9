"""A plant step by step: its state between steps, and one step of it.

The forces of the body are integrated by trapezoids, as over whole drives; those that depend on the speed at the end of
the step are found by fixed-point iterations, each of which gains some three digits.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.actuator import ActuatorState
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.effect_context import EffectContext
from avtorch.gap.simulator.order import actuator_of, at_place, substeps
from avtorch.vehicle.loop import Noise
from avtorch.vehicle.plant import Motion

ROUNDS = 5


@dataclass(frozen=True)
class SimulationState:
    """The state of a drive from step to step; never modified, so copies share it."""

    effects: tuple[Effect, ...]
    T_L: Tensor
    K_L: Tensor
    noise: dict[str, Noise]
    row: int
    time: float
    dt: float  # the step that led to this state
    seen: Tensor  # the acceleration returned to the loop
    seen_speed: Tensor  # the speed that the sensor shows
    speed: Tensor
    position: Tensor
    actuator: ActuatorState
    force: Tensor
    memory: dict[str, Any]


def goes_on(past: SimulationState, a: Tensor) -> bool:
    """Whether `a` is the acceleration that the last step returned, hence the same drive.

    This holds for the same memory (also where a loop's copy expanded it), or for equal values. Equal values do not
    identify a car at rest without acceleration.
    """
    if a.data_ptr() == past.seen.data_ptr():
        return True
    if a.shape != past.seen.shape:
        return False
    return bool((a == past.seen).all()) and bool((a != 0).any())


def begin(
    effects: tuple[Effect, ...], a: Tensor, v: Tensor, u: Tensor, dt: float, T_L: Tensor, K_L: Tensor, seed: int
) -> SimulationState:
    """A drive that starts at the car's acceleration `a` and speed `v`, its commands in steady state at `u`."""
    effects = tuple(
        e.drawn(torch.Generator().manual_seed(_stream(e.name, seed)) if e.place == "body" else None) for e in effects
    )
    noise = {e.name: _noise(e.name, seed, a) for e in effects if e.random}
    shape = np.broadcast_shapes(a.shape, v.shape, u.shape)
    a, v, u = (x.expand(shape) for x in (a, v, u))
    zero = torch.zeros_like(v)
    past = SimulationState(effects, T_L, K_L, noise, 0, 0.0, dt, a, v, v, zero, ActuatorState(a), zero, {})
    row = context_of(past, 0.0, v, zero, dt)
    memory: dict[str, Any] = {}
    for e in effects:  # each in steady state at the previous one's output
        if e.place in ("command", "actuator"):
            at = drawn_for(past, e, row, past.row)
            memory[e.name] = e.start(u, at)
            if e.place == "command":
                out = e.advance(u, at, memory[e.name])[0]
                u = out[1] if isinstance(out, tuple) else out
    bodies, force = at_place(effects, "body"), zero
    for e in bodies:
        at = drawn_for(past, e, row, past.row)
        force = force + e.advance(a, at, e.start(a, at))[0]
    own = a - force  # the actuator's share is the car's acceleration less the other forces
    for e in bodies:
        at = drawn_for(past, e, row, past.row)
        memory[e.name] = e.advance(own, at, e.start(own, at))[1]
    measured = a
    for e in at_place(effects, "sensor"):
        at = drawn_for(past, e, row, past.row)
        measured, memory[e.name] = e.advance(measured, at, e.start(measured, at))
    for e in at_place(effects, "sensor", "speed"):
        memory[e.name] = e.advance(v, row, e.start(v, row))[1]
    return replace(past, actuator=actuator_of(effects).steady_state(own), force=force, memory=memory)


def move(past: SimulationState, v: Tensor, u: Tensor, dt: float, eps: Tensor) -> tuple[Motion, SimulationState]:
    """One step, `u` and jerk noise `eps` held: `(measured acceleration, speed, displacement)` and the new state."""
    # by trapezoids of the speeds, as for a log
    position = past.position if past.row == 0 else past.position + 0.5 * past.dt * (past.speed + v)
    row = context_of(past, past.time, v, position, dt)
    number, time = past.row + 1, past.time + dt
    memory = dict(past.memory)

    def hook(e: Effect, x: Tensor) -> Any:
        y, memory[e.name] = e.advance(x, drawn_for(past, e, row, past.row), memory[e.name])
        return y

    parts = substeps(past.effects, u, row, hook)
    parts = [replace(part, target=torch.addcmul(part.target, part.lag, eps)) for part in parts]
    state, gained, moved = actuator_of(past.effects).step(past.actuator, parts)

    bodies = at_place(past.effects, "body")
    force, speed = past.force, v + gained
    if bodies:
        speed = speed + dt * past.force
        for _ in range(ROUNDS if any(e.needs_speed for e in bodies) else 1):
            after = context_of(past, time, speed, position + 0.5 * dt * (v + speed), dt)
            force = torch.zeros_like(speed)
            for e in bodies:
                y, kept = e.advance(state.accel, drawn_for(past, e, after, number), past.memory[e.name])
                force, memory[e.name] = force + y, kept
            speed = v + gained + 0.5 * dt * (past.force + force)
        moved = moved + dt * dt * (past.force / 3 + force / 6)
    after = context_of(past, time, speed, position + 0.5 * dt * (v + speed), dt)
    seen = state.accel + force
    for e in at_place(past.effects, "sensor"):
        seen, memory[e.name] = e.advance(seen, drawn_for(past, e, after, number), memory[e.name])
    seen_speed = speed.clamp_min(0.0)  # no car rolls back
    for e in at_place(past.effects, "sensor", "speed"):
        seen_speed, memory[e.name] = e.advance(seen_speed, after, memory[e.name])
    kept = replace(
        past,
        row=number,
        time=time,
        dt=dt,
        seen=seen,
        seen_speed=seen_speed,
        speed=v,
        position=position,
        actuator=state,
        force=force,
        memory=memory,
    )
    return (seen, speed, v * dt + moved), kept


def context_of(past: SimulationState, time: float, v: Tensor, x: Tensor, dt: float) -> EffectContext:
    now, step = torch.tensor(time, dtype=torch.float64), torch.tensor(dt, dtype=torch.float64)
    return EffectContext(now, step, v, x, past.T_L, past.K_L, whole=False)


def drawn_for(past: SimulationState, effect: Effect, row: EffectContext, number: int) -> EffectContext:
    """The row with the effect's own draw, if it is random."""
    if not effect.random:
        return row
    return replace(row, normal=past.noise[effect.name].steps(number, 1)[0])


def _stream(name: str, seed: int) -> int:
    return (zlib.crc32(name.encode()) << 20) + seed


def _noise(name: str, seed: int, a: Tensor) -> Noise:
    """Draws of the shape of the loop's state: (scenario,), or (vehicle, scenario) in a platoon."""
    return Noise(_stream(name, 0) + 7919 * seed, a.shape[-1] if a.dim() else 1, a.shape[-2] if a.dim() > 1 else None)
