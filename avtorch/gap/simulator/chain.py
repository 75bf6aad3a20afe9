"""The chain of effects: its order, its response to whole drives, and one step of it.

Over whole drives all rows and all parameter columns are computed at once. Step by step, the forces of the body are
integrated by trapezoids as well; those that depend on the speed at the end of the step are found by fixed-point
iterations, each of which gains some three digits.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.actuator import Actuator, ActuatorState, Substep
from avtorch.gap.simulator.effect import PLACES, Effect, EffectContext, Place, context_at
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput
from avtorch.vehicle.loop import Noise
from avtorch.vehicle.plant import Motion

Hook = Callable[[Effect, Tensor], Any]
"""Runs an effect with memory: `hook(effect, x) -> output`, for one row or a whole drive."""


def in_order(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects by place, then by their own order."""
    return tuple(sorted(effects, key=lambda e: (PLACES.index(e.place), e.order, e.name)))


def at_place(effects: Iterable[Effect], place: Place, reading: str = "accel") -> list[Effect]:
    """The effects at that place, in order; of a sensor's those on that reading."""
    return [e for e in effects if e.place == place and e.reading == reading]


def substeps(effects: Iterable[Effect], u: Tensor, row: EffectContext, hook: Hook) -> list[Substep]:
    """Targets, lags and lengths of each step's parts: the command through its effects, then gains and lags."""
    late, early, first = u, None, None
    for e in at_place(effects, "command"):
        out = hook(e, late)
        if isinstance(out, tuple):
            early, late, first = out
        else:  # what follows a delay has no memory
            early = None if early is None else hook(e, early)
            late = out
    pieces = [(late, row.dt)]
    if early is not None and first is not None:
        pieces = [(early, first), (late, row.dt - first)]
    once = {e.name: hook(e, late) for e in at_place(effects, "actuator") if e.memory}
    parts = []
    for command, length in pieces:
        gain, lag = row.K_L, row.T_L
        for e in at_place(effects, "actuator"):
            more, slower = once[e.name] if e.memory else e.apply(command, row)
            gain, lag = gain * more, lag * slower
        parts.append(Substep(gain * command, lag, length))
    return parts


def actuator_of(effects: Iterable[Effect]) -> Actuator:
    """The actuator: first order, unless effects change it."""
    given: dict[str, Tensor] = {}
    for e in effects:
        given |= e.actuator_parameters()
    return Actuator(**given)


# whole drives -------------------------------------------------------------------------------------------------------
STANDS_MPS = 0.1
"""Measured speed below which the car stands and its acceleration is zero [m/s]."""


def rollout(
    effects: Iterable[Effect],
    T_L: Tensor,
    K_L: Tensor,
    drive: SimulatorInput,
    generator: torch.Generator | None = None,
) -> Response:
    """See `GapPlant.response`; effects with values (...), in the chain's order."""
    single = [e if generator is None else e.drawn(generator) for e in effects]
    dt = drive.dt[0] if drive.uniform else drive.dt
    row = EffectContext(drive.time, dt, drive.speed, drive.position, T_L[..., None], K_L[..., None])
    shape = _shape(single, row, drive)
    rows, whole = {}, []
    for e in single:
        drawn = generator is not None and e.random
        normal = torch.randn(shape, generator=generator, dtype=torch.float64) if drawn else None
        rows[e.name] = replace(row, normal=normal)
        if e.memory and type(e).over is Effect.over:  # looped over rows: its values stay (...)
            whole.append(e)
            continue
        whole.append(replace(e, **{k: v[..., None] for k, v in e.values().items()}))

    parts = substeps(whole, drive.command, row, lambda e, u: e.over(u, rows[e.name]))
    accel0 = parts[0].target[..., 0]
    if drive.accel0 is not None:
        accel0 = start = torch.as_tensor(drive.accel0).expand(shape[:-1])
        # the actuator's share is the car's acceleration less the other forces
        for e in at_place(single, "body"):
            if e.gravity and drive.specific_force:
                continue
            at = context_at(rows[e.name], 0)
            accel0 = accel0 - e.advance(start, at, e.start(start, at))[0]
    # columns that differ in forces or sensors only share the actuator's motion
    a, gained = actuator_of(whole).over(accel0, parts)

    forces = [e.over(a, rows[e.name]) for e in at_place(whole, "body")]
    accel = a.expand(shape)
    if forces:
        force = torch.stack([f.expand(shape) for f in forces]).sum(0) if len(forces) > 1 else forces[0].expand(shape)
        accel = a + force
        gained = gained + 0.5 * (dt if drive.uniform else dt[:-1]) * (force[..., 1:] + force[..., :-1])
    measured = accel
    if drive.specific_force:
        for e, force in zip(at_place(whole, "body"), forces, strict=True):
            measured = measured - force if e.gravity else measured
    sensors = at_place(whole, "sensor")
    if sensors and drive.speed is not None:
        # the reading of a lagging sensor reaches zero some time after the car stops
        measured = torch.where(drive.speed < STANDS_MPS, 0.0, measured)
    for e in sensors:
        measured = e.over(measured, rows[e.name])
    v0 = torch.zeros((), dtype=a.dtype) if drive.speed is None else drive.speed[..., 0]
    v0 = v0.expand(shape[:-1])[..., None]
    shown = speed = torch.cat([v0, v0 + gained.cumsum(-1)], -1)
    for e in at_place(whole, "sensor", "speed"):
        shown = e.over(shown, rows[e.name])
    return Response(accel, measured, speed, shown)


def _shape(effects: list[Effect], row: EffectContext, drive: SimulatorInput) -> torch.Size:
    """The common shape (..., time) of all inputs."""
    shapes = [drive.command.shape, row.T_L.shape, row.K_L.shape]
    shapes += [x.shape for x in (drive.speed,) if x is not None]
    shapes += [(*x.shape, 1) for x in (drive.accel0,) if isinstance(x, Tensor)]
    for e in effects:
        shapes += [(*v.shape, 1) for v in e.values().values()]
    return torch.Size(np.broadcast_shapes(*shapes))


# one step -----------------------------------------------------------------------------------------------------------
_ROUNDS = 5


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
    """A drive that starts at the car's acceleration `a` and speed `v`, its commands in steady state at `u`; `seen` is
    what the sensor shows of `a`."""
    effects = tuple(e.drawn(torch.Generator().manual_seed(_stream(e.name, seed))) for e in effects)
    noise = {e.name: _noise(e.name, seed, a) for e in effects if e.random}
    shape = np.broadcast_shapes(a.shape, v.shape, u.shape)
    a, v, u = (x.expand(shape) for x in (a, v, u))
    zero = torch.zeros_like(v)
    past = SimulationState(effects, T_L, K_L, noise, 0, 0.0, dt, a, v, v, zero, ActuatorState(a), zero, {})
    row = context_of(past, v, zero, dt)
    memory: dict[str, Any] = {}
    for e in effects:  # each in steady state at the previous one's output
        if e.place in ("command", "actuator"):
            at = drawn_for(past, e, row)
            memory[e.name] = e.start(u, at)
            if e.place == "command":
                out = e.advance(u, at, memory[e.name])[0]
                u = out[1] if isinstance(out, tuple) else out
    bodies, force = at_place(effects, "body"), zero
    for e in bodies:
        at = drawn_for(past, e, row)
        force = force + e.advance(a, at, e.start(a, at))[0]
    own = a - force  # the actuator's share is the car's acceleration less the other forces
    for e in bodies:
        at = drawn_for(past, e, row)
        memory[e.name] = e.advance(own, at, e.start(own, at))[1]
    measured = a
    for e in at_place(effects, "sensor"):
        at = drawn_for(past, e, row)
        measured, memory[e.name] = e.advance(measured, at, e.start(measured, at))
    for e in at_place(effects, "sensor", "speed"):
        memory[e.name] = e.advance(v, row, e.start(v, row))[1]
    actuator = actuator_of(effects).steady_state(own)
    return replace(past, seen=measured, actuator=actuator, force=force, memory=memory)


def move(past: SimulationState, v: Tensor, u: Tensor, dt: float, eps: Tensor) -> tuple[Motion, SimulationState]:
    """One step, `u` and jerk noise `eps` held: `(measured acceleration, speed, displacement)` and the new state."""
    # by trapezoids of the speeds, as for a log
    position = past.position if past.row == 0 else past.position + 0.5 * past.dt * (past.speed + v)
    row = context_of(past, v, position, dt)
    number, time = past.row + 1, past.time + dt
    memory = dict(past.memory)

    def hook(e: Effect, x: Tensor) -> Any:
        y, memory[e.name] = e.advance(x, drawn_for(past, e, row), memory[e.name])
        return y

    parts = substeps(past.effects, u, row, hook)
    parts = [replace(part, target=torch.addcmul(part.target, part.lag, eps)) for part in parts]
    state, gained, moved = actuator_of(past.effects).step(past.actuator, parts)

    end = end_of_step(replace(past, row=number, time=time, memory=memory), state.accel, v, gained, position, dt)
    moved = moved + dt * dt * (past.force / 3 + end.force / 6)
    kept = replace(end, dt=dt, speed=v, position=position, actuator=state)
    return (end.seen, end.speed, v * dt + moved), kept


def end_of_step(
    past: SimulationState, accel: Tensor, v: Tensor, gained: Tensor, position: Tensor, dt: float
) -> SimulationState:
    """`past`, of which `row` and `time` are already those of the step's end, with speed, force and readings there.

    Over the step from speed `v` and `position` the actuator, which is at `accel` now, has `gained` speed.
    """

    def at_end(speed: Tensor) -> EffectContext:
        return context_of(past, speed, position + 0.5 * dt * (v + speed), dt)

    bodies, memory = at_place(past.effects, "body"), dict(past.memory)
    force, speed = past.force, v + gained + dt * past.force
    rounds = 0 if not bodies else _ROUNDS if any(e.needs_speed for e in bodies) else 1
    for _ in range(rounds):
        after, force = at_end(speed), torch.zeros_like(speed)
        for e in bodies:
            y, memory[e.name] = e.advance(accel, drawn_for(past, e, after), past.memory[e.name])
            force = force + y
        speed = v + gained + 0.5 * dt * (past.force + force)
    after, seen = at_end(speed), accel + force
    for e in at_place(past.effects, "sensor"):
        seen, memory[e.name] = e.advance(seen, drawn_for(past, e, after), past.memory[e.name])
    seen_speed = speed.clamp_min(0.0)  # no car rolls back
    for e in at_place(past.effects, "sensor", "speed"):
        seen_speed, memory[e.name] = e.advance(seen_speed, after, past.memory[e.name])
    return replace(past, seen=seen, seen_speed=seen_speed, speed=speed, force=force, memory=memory)


def context_of(past: SimulationState, v: Tensor, x: Tensor, dt: float) -> EffectContext:
    now, step = torch.tensor(past.time, dtype=torch.float64), torch.tensor(dt, dtype=torch.float64)
    return EffectContext(now, step, v, x, past.T_L, past.K_L)


def drawn_for(past: SimulationState, effect: Effect, row: EffectContext) -> EffectContext:
    """The row with the effect's own draw, if it is random."""
    if not effect.random:
        return row
    return replace(row, normal=past.noise[effect.name].steps(past.row, 1)[0])


def _stream(name: str, seed: int) -> int:
    return (zlib.crc32(name.encode()) << 20) + seed


def _noise(name: str, seed: int, a: Tensor) -> Noise:
    """Draws of the shape of the loop's state: (scenario,), or (vehicle, scenario) in a platoon."""
    return Noise(_stream(name, 0) + 7919 * seed, a.shape[-1] if a.dim() else 1, a.shape[-2] if a.dim() > 1 else None)
