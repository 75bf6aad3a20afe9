"""Gear shifts: the drive torque is interrupted during a gear change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from avtorch.gap.simulator.domain import Domain
from avtorch.gap.simulator.effect import Effect, fixed, register
from avtorch.gap.simulator.effect_context import EffectContext
from avtorch.gap.simulator.parameter import Parameter
from avtorch.vehicle.arguments import Number, tensor

_REARMED = 1.5  # [m/s] below a shift speed at which the gear counts as changed back, without interruption
_NEVER = -1e9
_SHIFTS = 6


@register
@dataclass(frozen=True)
class GearShift(Effect):
    """Where the speed rises through one of `speeds` [m/s], a positive command loses the share `depth` for `duration_s`.

    Neutral at depth 0. Without `speeds`, they are those of a gearbox with constant ratio: `first_mps`, each next one
    `gear_ratio` times the previous. The crossing is interpolated between rows, and a row loses drive for the part of
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

    name = "gear_shift"
    place = "actuator"
    memory = True
    needs_speed = True
    meaning = "upshifts at certain speeds interrupt the drive torque"
    equation = "K_L (1 - depth) for duration after each upshift, where u > 0"
    of_the_drive = True
    starts = fixed(
        depth=(0.5,),
        duration_s=(0.25,),
        first_mps=tuple(np.arange(3.2, 6.9, 0.2)),
        gear_ratio=tuple(np.arange(1.35, 1.77, 0.035)),
    )
    parameters = (
        Parameter("depth", "-", 0.0, 0.3, 0.95, "unit"),
        Parameter("duration_s", "s", None, 0.1, 0.6, possible=(0.02, 2.5), beyond="no gear shift has that duration"),
        Parameter("first_mps", "m/s", None, 3.0, 7.0, reported=False),
        Parameter("gear_ratio", "-", None, 1.3, 1.8, reported=False),
    )
    settings = (Domain("speeds", 0.1, 150.0, "m/s", most=16, rising=True),)

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
            since = torch.where(up, self._crossing(v_before, v, s, row), since)
            above = (above | up) & (v > s - _REARMED)
            lost = torch.maximum(lost, self._covered(since, row))
            after.append((v, above, since))
        return (self._factor(lost, x), 1.0), after

    def over(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        v, lost = row.speed, torch.zeros(())
        before = torch.cat([v[..., :1], v[..., :-1]], -1)
        rows = torch.arange(v.shape[-1])
        for s in self._thresholds():
            # hysteresis: the state is that of the last row that armed or fired
            fired = torch.where(v > s, rows, -1).cummax(-1).values
            armed = torch.where(v <= s - _REARMED, rows, -1).cummax(-1).values
            above = fired > armed
            was = torch.cat([v[..., :1] > s, above[..., :-1]], -1)
            up = (v > s) & ~was
            last = torch.where(up, rows, -1).cummax(-1).values
            crossing = self._crossing(before, v, s, row)
            crossing = crossing.expand(np.broadcast_shapes(crossing.shape, last.shape))
            since = torch.where(last < 0, _NEVER, crossing.gather(-1, last.expand_as(crossing).clamp_min(0)))
            lost = torch.maximum(lost, self._covered(since, row))
        return self._factor(lost, x), 1.0

    def _thresholds(self) -> list[Tensor]:
        if self.speeds is not None:
            return [tensor(s) for s in self.speeds]
        return [tensor(self.first_mps) * tensor(self.gear_ratio) ** i for i in range(_SHIFTS)]

    def _crossing(self, before: Tensor, v: Tensor, s: Tensor, row: EffectContext) -> Tensor:
        """Start of the interruption: one row after the crossing, so that it is known when a step begins."""
        gained = v - before
        share = ((v - s) / torch.where(gained > 0, gained, 1.0)).clamp(0.0, 1.0)
        return row.time + (1 - share) * row.dt

    def _covered(self, since: Tensor, row: EffectContext) -> Tensor:
        begin = torch.maximum(row.time, since)
        end = torch.minimum(row.time + row.dt, since + tensor(self.duration_s))
        return ((end - begin) / row.dt).clamp_min(0.0)

    def _factor(self, lost: Tensor, x: Tensor) -> Tensor:
        return torch.where(x > 0, 1 - tensor(self.depth) * lost, 1.0)
