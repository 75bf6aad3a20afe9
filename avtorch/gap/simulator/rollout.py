"""A plant's response to whole drives, all rows and all parameter columns at once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.actuator import Actuator, Substep
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.effect_context import EffectContext, context_at
from avtorch.gap.simulator.order import actuator_of, at_place, substeps
from avtorch.gap.simulator.simulator_input import Response, SimulatorInput

STANDS_MPS = 0.1
"""Measured speed below which the car stands and its acceleration is zero [m/s]."""


def rollout(
    effects: Iterable[Effect],
    T_L: Tensor,
    K_L: Tensor,
    drive: SimulatorInput,
    generator: torch.Generator | None = None,
    *,
    actuator0: Tensor | None = None,
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
        long = {p.name for p in e.coordinates() if p.size > 1}
        whole.append(replace(e, **{k: v if k in long else v[..., None] for k, v in e.values().items()}))

    parts = substeps(whole, drive.command, row, lambda e, u: e.over(u, rows[e.name]))
    accel0 = parts[0].target[..., 0]
    if actuator0 is not None:
        accel0 = actuator0
    elif drive.accel0 is not None:
        accel0 = start = torch.as_tensor(drive.accel0).expand(shape[:-1])
        # the actuator's share is the car's acceleration less the other forces
        for e in at_place(single, "body"):
            if e.gravity and drive.specific_force:
                continue
            at = context_at(rows[e.name], 0)
            accel0 = accel0 - e.advance(start, at, e.start(start, at))[0]
    actuator = actuator_of(whole)
    # columns that differ in forces or sensors only share the actuator's motion
    a, gained = actuator.over(accel0.expand(_own_shape(accel0, parts, actuator)), parts)

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
        long = {p.name for p in e.coordinates() if p.size > 1}
        shapes += [(*(v.shape[:-1] if k in long else v.shape), 1) for k, v in e.values().items()]
    return torch.Size(np.broadcast_shapes(*shapes))


def _own_shape(accel0: Tensor, parts: list[Substep], actuator: Actuator) -> torch.Size:
    """The common shape (...) of what moves the actuator."""
    by_row = [x for part in parts for x in (part.target, part.lag, part.length)]
    by_row += [x for x in (actuator.tau, actuator.jerk, actuator.fall) if x is not None]
    return torch.Size(np.broadcast_shapes(accel0.shape, *(x.shape[:-1] for x in by_row)))
