"""The closed loop: leader → upper level → lower level → plant → spacing, tick by tick, batched over scenarios.

Jerk noise is drawn by scenario seed and step number, counter-based (Philox), hence with random access: the draw at a
step depends on the seed, the vehicle and the step alone. A scenario therefore gives the same run alone or in a batch,
for any division into blocks, and copying a loop copies no generator. numpy, because torch's CPU generator keeps 32 bits
of a seed and cannot jump.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number, checked, tensor
from avtorch.vehicle.block import Block, Trajectory
from avtorch.vehicle.controllers import Controller, FollowerState, LinearController
from avtorch.vehicle.leader import Leader
from avtorch.vehicle.lower_level import LowerLevel
from avtorch.vehicle.plant import GLVDPlant, Plant, PlantFunction

_CHUNK = 1024  # steps drawn together: amortises the set-up of a stream


class Noise:
    """Standard normal draws for `seeds` (one per scenario) and `vehicles`."""

    def __init__(self, seeds: int | Sequence[int] | Tensor | None, scenarios: int, vehicles: int | None = None) -> None:
        """`seeds`: one per scenario; an int `s` means s, s+1, …; None means 0, 1, …. Raises `InputError` otherwise."""
        if seeds is None or isinstance(seeds, int):
            listed = [(seeds or 0) + i for i in range(scenarios)]
        else:
            listed = [int(s) for s in seeds]
        if len(listed) != scenarios or any(not 0 <= s < 2**63 for s in listed):
            raise InputError(f"seeds: found {len(listed)} for {scenarios} scenarios, needs one >= 0 for each")
        self.seeds = tuple(listed)
        self.vehicles = vehicles
        self._cached: tuple[int, Tensor] | None = None

    def _chunk(self, number: int) -> Float[Tensor, "time *vehicle scenario"]:
        if self._cached is None or self._cached[0] != number:
            rows = [
                [np.random.Generator(np.random.Philox(key=s, counter=[0, 0, i, number])) for s in self.seeds]
                for i in range(self.vehicles or 1)
            ]
            drawn = np.stack([np.stack([g.standard_normal(_CHUNK) for g in row], -1) for row in rows], -2)
            self._cached = number, torch.as_tensor(drawn if self.vehicles else drawn[:, 0])
        return self._cached[1]

    def steps(self, first: int, count: int) -> Float[Tensor, "time *vehicle scenario"]:
        """Draws of steps `first` … `first + count - 1`, (time, scenario), or (time, vehicle, scenario) in a platoon."""
        parts: list[Tensor] = []
        while count > 0:
            number, offset = divmod(first, _CHUNK)
            part = self._chunk(number)[offset : offset + count]
            parts.append(part)
            first, count = first + part.shape[0], count - part.shape[0]
        return torch.cat(parts)


class ClosedLoop:
    """Followers behind a `leader`, one per scenario, advanced in blocks.

    `controller`, `lower_level` and `plant` are plain attributes: replace them between two `advance` calls and the new
    one acts from the next row on, with the car's state carried over. Their parameters are floats or tensors
    (scenario,), in a platoon also (vehicle, 1). With `vehicles=n` vehicle 0 follows the leader and each other one the
    one before.

    Within a step command and noise are held and the plant integrates (exactly, by default).

    Physical limits: a car does not roll back. At standstill the speed is 0 and the kinematic acceleration (logged, and
    passed to the controllers) is 0 until the actuator's own acceleration, which goes on obeying the plant, turns
    positive. A collision is recorded but not simulated: the spacing becomes negative, so that its minimum shows how
    hard the collision was; `collided` stays set, and later rows of that scenario are not physical.

    Args:
        leader: its `dt` must be the loop's.
        controller: any callable on `FollowerState`.
        lower_level: the command sent.
        plant: a `Plant`, or a function with the arguments of its `step`.
        dt: step [s], None for the leader's.
        scenarios: how many.
        vehicles: None for a single follower.
        seeds: of the jerk noise, one per scenario; an int s means s, s+1, …; None means 0, 1, ….
        spacing0: [m], None for the controller's equilibrium at the leader's first speed (5 m + 1 s where it has
            no time gap).
        speed0: [m/s], None for the leader's first speed.
        link_delay: [s], age of the leader's acceleration that the controller receives (a radio link; rounded to steps).

    Raises `InputError` for bad arguments, and from `advance` where the leader ends before the block does.

    Example:
        >>> from avtorch import ClosedLoop, GLVDPlant, Leader
        >>> loop = ClosedLoop(Leader.default(start=180.0, duration=20.0, dt=0.05), scenarios=2)
        >>> before = loop.advance(200)
        >>> loop.plant = GLVDPlant(T_L=1.5, K_L=0.5)  # the actuator degrades, the car's state is carried over
        >>> after = loop.advance(200)
        >>> tuple(after.accel.shape), round(float(after.time[0]), 2)
        ((2, 200), 10.0)
    """

    def __init__(
        self,
        leader: Leader,
        controller: Controller | None = None,
        *,
        lower_level: LowerLevel | None = None,
        plant: Plant | PlantFunction | None = None,
        dt: float | None = None,
        scenarios: int = 1,
        vehicles: int | None = None,
        seeds: int | Sequence[int] | Tensor | None = None,
        spacing0: Number | None = None,
        speed0: Number | None = None,
        link_delay: float = 0.0,
    ) -> None:
        if scenarios < 1 or (vehicles is not None and vehicles < 1):
            raise InputError(f"scenarios, vehicles: found {scenarios}, {vehicles}, needs 1 or more")
        if dt is not None and abs(dt - leader.dt) > 1e-9:
            raise InputError(f"dt: found {dt!r} with a leader sampled every {leader.dt:g} s, needs the same")
        if not 0 <= link_delay < float("inf"):
            raise InputError(f"link_delay: found {link_delay!r}, needs >= 0 s")
        self.leader = leader
        self.controller: Controller = LinearController() if controller is None else controller
        self.lower_level = LowerLevel() if lower_level is None else lower_level
        self.plant: Plant | PlantFunction = GLVDPlant() if plant is None else plant
        self.dt = leader.dt
        self.scenarios, self.vehicles = scenarios, vehicles
        self.steps_done: int = 0
        self._noise = Noise(seeds, scenarios, vehicles)
        shape = (scenarios,) if vehicles is None else (vehicles, scenarios)
        lead_speed = leader.speed[..., 0].expand(shape)
        speed = lead_speed if speed0 is None else checked("speed0", speed0, unit="m/s", least=0.0).expand(shape)
        if spacing0 is None:
            gap = getattr(self.controller, "time_gap", 1.0)
            spacing = getattr(self.controller, "standstill", 5.0) + gap * speed
        else:
            spacing = checked("spacing0", spacing0, unit="m", above=0.0)
        spacing = spacing.expand(shape)
        self._v = speed.contiguous()
        self._a = torch.zeros_like(self._v)  # the actuator's, not the kinematic one
        ahead = spacing if vehicles is None else spacing.cumsum(0)
        self._x = leader.position[..., 0] - ahead
        self._hit = torch.zeros(shape, dtype=torch.bool)
        self._link: list[Tensor] = []
        self._link_steps = round(link_delay / leader.dt)

    @property
    def time(self) -> float:
        """Time of the next row [s]."""
        return self.steps_done * self.dt

    @property
    def link_delay(self) -> float:
        """Age of the leader's acceleration that the controller receives [s], in whole steps."""
        return self._link_steps * self.dt

    @property
    def collided(self) -> Bool[Tensor, "*scenario"]:
        """Whether the spacing has been zero or less so far, (scenario,) or (scenario, vehicle)."""
        return self._hit.movedim(-1, 0) if self.vehicles is not None else self._hit

    def copy(self, *, candidates: int | None = None) -> ClosedLoop:
        """An independent loop in the same state; tensors are shared (they are never written to), so this is cheap.

        With `candidates=n` the state gains a leading dimension: settings of shape (candidate, 1) or (candidate,
        scenario) may then be compared under common noise, and blocks have shape (candidate, scenario, time).
        """
        if candidates is not None and (candidates < 1 or self.vehicles is not None):
            raise InputError(f"candidates: found {candidates}, needs 1 or more, and no platoon")
        twin = copy.copy(self)
        twin.controller, twin.plant = copy.deepcopy(self.controller), copy.deepcopy(self.plant)
        twin._link = list(self._link)
        twin._noise = copy.copy(self._noise)
        if candidates is not None:
            for name in ("_x", "_v", "_a", "_hit"):
                state = getattr(self, name)
                setattr(twin, name, state.expand(candidates, *state.shape))
        return twin

    @torch.no_grad()
    def advance(self, steps: int) -> Block:
        """Run `steps` ticks; returns their rows, (scenario, time). Raises `InputError` beyond the leader's end."""
        first = self.steps_done
        if steps < 1:
            raise InputError(f"steps: found {steps}, needs 1 or more")
        if first + steps > self.leader.time.shape[-1]:
            needed = (first + steps - 1) * self.dt
            raise InputError(f"leader {self.leader.name}: ends at {self.leader.duration:g} s, needs {needed:g} s")
        span = slice(first, first + steps)
        lead = [s[..., span].unbind(-1) for s in (self.leader.position, self.leader.speed, self.leader.accel)]
        plant, lower = self.plant, self.lower_level
        move = cast(PlantFunction, getattr(plant, "step", plant))
        read = getattr(plant, "speed_reading", None)
        sigma = tensor(getattr(plant, "sigma", 0.0))
        noise = self._noise.steps(first, steps)
        eps_all = sigma * _time_first(noise, max(noise.dim(), sigma.dim() + 1))
        eps = eps_all.unbind(0)
        x, v, a, dt = self._x, self._v, self._a, self.dt
        rows: list[tuple[Tensor, ...]] = []
        standing = bool((v <= 0).any())
        nowhere = torch.zeros_like(self._hit)
        for i in range(steps):
            lead_x, lead_v, lead_a = lead[0][i], lead[1][i], lead[2][i]
            held = (v <= 0) & (a <= 0) if standing else nowhere
            kinematic = torch.where(held, 0.0, a) if standing else a
            if self.vehicles is not None:
                lead_x, lead_v = self._in_front(lead_x, x), self._in_front(lead_v, v)
                lead_a = self._in_front(lead_a, kinematic)
            spacing = lead_x - x
            time = (first + i) * dt
            seen = lead_a if self._link_steps == 0 else self._through_link(lead_a)
            shown = v if read is None else read(a, v)
            demanded = self.controller(FollowerState(time, spacing, shown, kinematic, lead_v, seen))
            raw = lower.raw_command(kinematic, demanded)
            command = lower.clip(raw)
            rows.append((command, kinematic, shown, spacing, lead_v, lead_a, demanded, raw, a, held))
            a, v_next, moved = move(a, v, command, dt, eps[i])
            stood, standing = standing, float(v_next.min()) <= 0
            if stood or standing:
                v_next, moved = _stop(v, v_next, moved, dt)
            x, v = x + moved, v_next
        block = self._block(rows, eps_all, first)
        self._x, self._v, self._a = x, v, a
        self.steps_done += steps
        return block

    def _in_front(self, leader_value: Tensor, own: Tensor) -> Tensor:
        return torch.cat([leader_value.expand(1, self.scenarios), own[:-1]])

    def _through_link(self, lead_accel: Tensor) -> Tensor:
        """The acceleration that the link delivers now; before its first message arrives, the leader's first."""
        self._link.append(lead_accel)
        return self._link.pop(0) if len(self._link) > self._link_steps else self._link[0]

    def _block(self, rows: list[tuple[Tensor, ...]], eps: Tensor, first: int) -> Block:
        shape = self._v.shape

        def series(column: int) -> Tensor:
            values = [row[column] for row in rows]
            if values[0].shape != shape:
                values = [value.expand(shape) for value in values]
            return torch.stack(values, -1)

        command, kinematic, speed, spacing, lead_v, lead_a, demanded, raw, actuator, held = (
            series(i) for i in range(10)
        )
        if not bool(torch.isfinite(demanded).all()):
            row = int(torch.nonzero(~torch.isfinite(demanded.reshape(-1, len(rows))).all(0))[0])
            raise InputError(f"controller: demanded a value that is not finite at {(first + row) * self.dt:g} s")
        self._hit = self._hit | (spacing <= 0).any(-1)
        jerk = torch.where(held, 0.0, self._jerk(actuator, command, eps))
        time = torch.arange(first, first + len(rows), dtype=torch.float64) * self.dt
        # time first, so that limits (scenario,) stay on the last dimension
        limited = self.lower_level.at_limit(command.movedim(-1, 0)).movedim(0, -1)
        clipped = (raw != command) | limited
        columns = (command, kinematic, speed, jerk, spacing, lead_v, lead_a, demanded, clipped)
        if self.vehicles is not None:
            columns = tuple(c.movedim(-2, 0) for c in columns)
        return Block(time, *columns)

    def _jerk(self, a: Tensor, u: Tensor, eps: Tensor) -> Tensor:
        """Noise-free jerk of every row plus that row's own draw; NaN where the plant does not give it."""
        jerk = getattr(self.plant, "jerk", None)
        if jerk is None:
            return torch.full_like(a, torch.nan)
        # time first, so that parameters (scenario,) stay on the last dimension
        return (jerk(a.movedim(-1, 0), u.movedim(-1, 0)) + _time_first(eps, a.dim())).movedim(0, -1)


def _time_first(eps: Float[Tensor, "time ... scenario"], dims: int) -> Float[Tensor, "time ... scenario"]:
    """(time, scenario) → (time, 1, …, scenario) of `dims` dimensions."""
    return eps.reshape(eps.shape[0], *([1] * (dims - eps.dim())), *eps.shape[1:])


def _stop(
    v: Float[Tensor, "*state"], v_next: Float[Tensor, "*state"], moved: Float[Tensor, "*state"], dt: float
) -> tuple[Float[Tensor, "*state"], Float[Tensor, "*state"]]:
    """A step that would end with negative speed ends at rest, after the distance to the stop at its mean
    deceleration."""
    back = v_next < 0
    # an actuator that turns positive within the step pulled backward before, on a standing car
    moved = torch.clamp(moved, min=0.0)
    to_rest = 0.5 * dt * v * v / torch.where(back, v - v_next, 1.0)
    return torch.where(back, 0.0, v_next), torch.where(back, to_rest, moved)


def simulate(
    leader: Leader,
    controller: Controller | None = None,
    *,
    duration: float | None = None,
    vehicles: int = 1,
    scenarios: int = 1,
    schedule: Sequence[tuple[float, Mapping[str, Any]]] = (),
    **settings: Any,
) -> Trajectory:
    """A whole run, (scenario, vehicle, time): a platoon of any length behind `leader`, all vehicles in one batch.

    Args: `duration` [s], None for the leader's whole length. `schedule`: `(time [s], {attribute: new value})`, for
    instance `[(26.0, {"plant": GLVDPlant(1.5, 0.5)})]`; attributes are `controller`, `lower_level`, `plant`. Other
    keywords as `ClosedLoop`. Parameters are floats or tensors (scenario,) or (vehicle, 1).

    Raises `InputError` for bad arguments and where the leader is shorter than `duration`.

    Example:
        >>> from avtorch import GLVDPlant, Leader, simulate
        >>> change = [(26.0, {"plant": GLVDPlant(T_L=1.5, K_L=0.5, sigma=0.0)})]
        >>> run = simulate(Leader.default(start=180.0, duration=40.0, dt=0.05), schedule=change)
        >>> tuple(run.speed.shape), round(float(run.spacing.min()), 1)
        ((1, 1, 800), 28.9)
    """
    steps = leader.time.shape[-1] - 1 if duration is None else round(duration / leader.dt)
    loop = ClosedLoop(leader, controller, vehicles=vehicles, scenarios=scenarios, **settings)
    blocks: list[Block] = []
    end: tuple[float, Mapping[str, Any]] = (steps * leader.dt, {})
    for time, change in [*sorted(schedule, key=lambda entry: entry[0]), end]:
        until = min(round(time / leader.dt), steps)
        if until > loop.steps_done:
            blocks.append(loop.advance(until - loop.steps_done))
        for name, value in change.items():
            if name not in ("controller", "lower_level", "plant"):
                raise InputError(f"schedule: found {name!r}, needs controller, lower_level or plant")
            setattr(loop, name, value)
    if not blocks:
        raise InputError(f"duration: found {duration!r}, needs at least one step of {leader.dt:g} s")
    whole = Block.concatenate(blocks)
    return Trajectory(**vars(whole))
