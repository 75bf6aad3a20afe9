"""Gear shifts: the drive torque is interrupted during a gear change."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_NEVER = -1e9
_SHIFTS = 6


@register
@dataclass(frozen=True)
class GearShift(Effect):
    """Where the speed rises through one of `speeds` [m/s], a positive command loses the share `depth` for `duration_s`.

    Neutral at depth 0. Without `speeds`, they are those of a gearbox with constant ratio: `first_mps`, each next one
    `gear_ratio` times the previous. Once the speed has fallen `rearm_mps` below a shift speed, the gear has changed
    back, without an interruption. The crossing is interpolated between rows, and a row loses drive for the part of
    its step that lies in the interruption, so the response is differentiable in duration and speeds.

    Possible are interruptions of 0.02 s (dual clutch) to 2.5 s (automated gearbox of a truck).

    Example:
        >>> import torch
        >>> from avtorch.gap import SimulatorInput, GearShift, plant
        >>> time = torch.arange(200, dtype=torch.float64) * 0.05
        >>> pulling = SimulatorInput(time, torch.ones_like(time), speed=4.0 + time)  # shifts at 4.5, 6.75, 10.1 m/s
        >>> accel = plant([GearShift(depth=0.7)], T_L=0.1).response(pulling).accel
        >>> accel.max().item() - accel.min().item() > 0.5
        True
    """

    depth: Number = 0.7
    duration_s: Number = 0.25
    first_mps: Number = 4.5
    gear_ratio: Number = 1.5
    speeds: tuple[float, ...] | None = None
    rearm_mps: float = 1.5

    name = "gear_shift"
    place = "actuator"
    needs_speed = True
    meaning = "upshifts at certain speeds interrupt the drive torque"
    equation = "K_L (1 - depth) for duration after each upshift, where u > 0"
    of_the_drive = True
    parameters = (
        Parameter("depth", "-", 0.0, 0.3, 0.95, "unit"),
        Parameter("duration_s", "s", None, 0.1, 0.6, possible=(0.02, 2.5), beyond="no gear shift has that duration"),
        Parameter("first_mps", "m/s", None, 3.0, 7.0, reported=False),
        Parameter("gear_ratio", "-", None, 1.3, 1.8, reported=False),
    )
    settings = (
        Domain("speeds", 0.1, 150.0, "m/s", most=16, rising=True),
        Domain("rearm_mps", 0.0, 20.0, "m/s"),
    )

    @classmethod
    def in_words(cls, values: Mapping[str, float]) -> str:
        return f"upshifts interrupt the drive torque for {values['duration_s']:.2g} s"

    def start(self, x: Tensor, row: EffectContext) -> list[tuple[Tensor, Tensor, Tensor]]:
        """State of each shift: speed one row ago, whether above, start of the last interruption."""
        v = row.speed
        return [(v, v > s, torch.full_like(v, _NEVER)) for s in self._thresholds()]

    def advance(
        self, x: Tensor, row: EffectContext, state: list[tuple[Tensor, Tensor, Tensor]]
    ) -> tuple[tuple[Tensor, float], list[tuple[Tensor, Tensor, Tensor]]]:
        v, lost, after = row.speed, torch.zeros(()), []
        for s, (v_before, above, since) in zip(self._thresholds(), state, strict=True):
            up = ~above & (v > s)
            since = torch.where(up, self._crossing(v_before, v, s, row.time, row.dt), since)
            above = (above | up) & (v > s - self.rearm_mps)
            lost = torch.maximum(lost, _covered(since, tensor(self.duration_s), row.time, row.dt))
            after.append((v, above, since))
        return (self._factor(lost, x), 1.0), after

    def over(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        """From the few rows that follow an upshift; elsewhere no drive is lost."""
        v, duration, thresholds = row.speed, tensor(self.duration_s), self._thresholds()
        shape = np.broadcast_shapes(v.shape, *((*p.shape[:-1], 1) for p in (duration, *thresholds)))
        columns, steps = math.prod(shape[:-1]), shape[-1]
        lost = torch.zeros(columns * steps, dtype=v.dtype)
        speed, time, dt = (y.expand(shape).reshape(columns, steps) for y in (v, row.time, row.dt))
        duration = duration.expand(*shape[:-1], 1).reshape(columns, 1)
        reach = torch.arange(int(duration.detach().max() / row.dt.min()) + 3)
        for s in thresholds:
            level = s.expand(*shape[:-1], 1).reshape(columns, 1)
            column, up, until = _upshifts(speed.numpy(), level.detach().numpy(), self.rearm_mps)
            at = column, up
            since = self._crossing(speed[column, up - 1], speed[at], level[column, 0], time[at], dt[at])
            rows = up[:, None] + reach
            event, ahead = (rows < until[:, None]).nonzero(as_tuple=True)
            column, rows = column[event], rows[event, ahead]
            own = _covered(since[event], duration[column, 0], time[column, rows], dt[column, rows])
            lost = lost.scatter_reduce(0, column * steps + rows, own, "amax")
        return self._factor(lost.reshape(shape), x), 1.0

    def _thresholds(self) -> list[Tensor]:
        if self.speeds is not None:
            return [tensor(s) for s in self.speeds]
        return [tensor(self.first_mps) * tensor(self.gear_ratio) ** i for i in range(_SHIFTS)]

    @staticmethod
    def _crossing(before: Tensor, v: Tensor, s: Tensor, time: Tensor, dt: Tensor) -> Tensor:
        """Start of the interruption: one row after the crossing, so that it is known when a step begins."""
        gained = v - before
        share = ((v - s) / torch.where(gained > 0, gained, 1.0)).clamp(0.0, 1.0)
        return time + (1 - share) * dt

    def _factor(self, lost: Tensor, x: Tensor) -> Tensor:
        return 1 - tensor(self.depth) * lost * (x > 0)


def _covered(since: Tensor, duration: Tensor, time: Tensor, dt: Tensor) -> Tensor:
    """Share of a step that lies in an interruption."""
    return ((torch.minimum(time + dt, since + duration) - torch.maximum(time, since)) / dt).clamp_min(0.0)


def _upshifts(v: FloatArray, s: FloatArray, rearm: float) -> tuple[Tensor, Tensor, Tensor]:
    """Columns and rows (event,) at which `v` (column, time) has risen through `s` (column, 1), in order, and the row of
    the column's next event. Between two of them the car has been slower by what changes the gear back."""
    steps, above = v.shape[-1], v > s
    risen = np.flatnonzero(np.diff(above, axis=-1, prepend=above[:, :1]) & above)
    fallen = np.flatnonzero(np.diff(above, axis=-1, prepend=above[:, :1]) & ~above)
    last = np.searchsorted(fallen, risen) - 1
    again = last >= np.searchsorted(fallen, risen // steps * steps)  # it was above before, in that column
    places = np.stack([fallen[last[again]], risen[again]], -1).ravel()
    slowest = np.minimum.reduceat(v.ravel(), places)[::2] if places.size else np.zeros(0)
    shifted = np.ones(len(risen), bool)
    shifted[again] = slowest <= s[risen[again] // steps, 0] - rearm
    column, row = np.divmod(risen[shifted], steps)
    follows = np.append(column[1:] == column[:-1], False)
    until = np.where(follows, np.append(row[1:], steps), steps)
    return torch.from_numpy(column), torch.from_numpy(row), torch.from_numpy(until)
