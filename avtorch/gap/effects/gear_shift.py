"""Gear shifts: the drive torque is interrupted during a gear change."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.simulator.effect import Domain, Effect, EffectContext, Parameter, register
from avtorch.vehicle.arguments import Number, tensor

_NEVER = -1e9


@register
@dataclass(frozen=True)
class GearShift(Effect):
    """Where the speed rises through one of `speeds` [m/s], a positive command loses the share `depth` for `duration_s`.

    Neutral at depth 0. By default the shift speeds are those of a gearbox of constant ratio. Once the speed has fallen
    `rearm_mps` below a shift speed, the gear has changed back, without an interruption. The crossing is interpolated
    between rows, and a row loses drive for the part of its step that lies in the interruption, so the response is
    differentiable in duration and speeds.

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
    speeds: tuple[float, ...] = (4.5, 6.75, 10.1, 15.2, 22.8, 34.2)
    rearm_mps: float = 1.5

    name = "gear_shift"
    place = "actuator"
    needs_speed = True
    meaning = "upshifts at certain speeds interrupt the drive torque"
    words = "upshifts interrupt the drive torque for {duration_s:.2g} s"
    equation = "K_L (1 - depth) for duration after each upshift, where u > 0"
    of_the_drive = True
    parameters = (
        Parameter("depth", "-", 0.0, 0.3, 0.95, "unit"),
        Parameter("duration_s", "s", None, 0.1, 0.6, possible=(0.02, 2.5)),
    )
    settings = (
        Domain("speeds", 0.1, 150.0, "m/s", most=16, rising=True),
        Domain("rearm_mps", 0.0, 20.0, "m/s"),
    )

    def start(self, x: Tensor, row: EffectContext) -> list[tuple[Tensor, Tensor, Tensor]]:
        """State of each shift: speed one row ago, whether above, start of the last interruption."""
        v = row.speed
        return [(v, v > s, torch.full_like(v, _NEVER)) for s in map(tensor, self.speeds)]

    def advance(
        self, x: Tensor, row: EffectContext, state: list[tuple[Tensor, Tensor, Tensor]]
    ) -> tuple[tuple[Tensor, float], list[tuple[Tensor, Tensor, Tensor]]]:
        v, lost, after = row.speed, torch.zeros(()), []
        for s, (v_before, above, since) in zip(map(tensor, self.speeds), state, strict=True):
            up = ~above & (v > s)
            since = torch.where(up, self._crossing(v_before, v, s, row.time, row.dt), since)
            above = (above | up) & (v > s - self.rearm_mps)
            lost = torch.maximum(lost, _covered(since, tensor(self.duration_s), row.time, row.dt))
            after.append((v, above, since))
        return (self._factor(lost, x), 1.0), after

    def over(self, x: Tensor, row: EffectContext) -> tuple[Tensor, float]:
        v, lost = row.speed, torch.zeros(())
        for s in map(tensor, self.speeds):
            shape = np.broadcast_shapes(v.shape, s.shape)
            columns = v.expand(shape).reshape(-1, shape[-1]).contiguous().numpy()
            levels = s.detach().expand(*shape[:-1], 1).reshape(-1).contiguous().numpy()
            last = torch.from_numpy(_last_upshift(columns, levels, self.rearm_mps)).reshape(shape)
            up = last.clamp_min(1)
            before, after, time, dt = (
                y.expand(shape).gather(-1, at) for y, at in ((v, up - 1), (v, up), (row.time, up), (row.dt, up))
            )
            since = torch.where(last > 0, self._crossing(before, after, s, time, dt), _NEVER)
            lost = torch.maximum(lost, _covered(since, tensor(self.duration_s), row.time, row.dt))
        return self._factor(lost, x), 1.0

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


@njit(cache=True)
def _last_upshift(v: FloatArray, s: FloatArray, rearm: float) -> IntArray:  # pragma: no cover - compiled
    """Row (column, time) of the latest rise of `v` (column, time) through `s` (column,); -1 before the first."""
    out = np.empty(v.shape, np.int64)
    for c in range(len(v)):
        above, last = v[c, 0] > s[c], -1
        for k in range(v.shape[1]):
            if v[c, k] > s[c] and not above:
                above, last = True, k
            above = above and v[c, k] > s[c] - rearm
            out[c, k] = last
    return out
