"""What a setting would have done over the last windows: the closed loop replayed behind the logged leader.

The replay starts from the state logged at the beginning of the stretch, follows the leader's logged speed and
acceleration with the posterior mean as the vehicle, and moves the time gap from the one in force at the loop's own
rate. From it the strategist predicts clipping and cost before it acts on the car.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number
from avtorch.vehicle.block import Block
from avtorch.vehicle.controllers import RAMP_RATE
from avtorch.vehicle.leader import Leader
from avtorch.vehicle.loop import ClosedLoop
from avtorch.vehicle.performance import Performance, performance
from avtorch.vehicle.plant import GLVDPlant

_ROWS = 4096  # closed loops simulated in one batch: larger batches only cost memory


@dataclass(frozen=True)
class History:
    """The last seconds as logged: `lead_speed` [m/s], `lead_accel` [m/s²] (scenario, time) at steps of `dt` [s]; the
    follower's `spacing` [m] and `speed` [m/s] (scenario,) at the beginning. Raises `InputError` for other shapes, or
    fewer than two rows.
    """

    dt: float
    lead_speed: Tensor
    lead_accel: Tensor
    spacing: Tensor
    speed: Tensor

    def __post_init__(self) -> None:
        if self.lead_speed.ndim != 2 or self.lead_speed.shape != self.lead_accel.shape:
            raise InputError(
                f"history: found lead_speed {tuple(self.lead_speed.shape)} and lead_accel "
                f"{tuple(self.lead_accel.shape)}, need (scenario, time) both"
            )
        if self.lead_speed.shape[1] < 2:
            raise InputError(f"history: found {self.lead_speed.shape[1]} rows, need 2 or more")

    @staticmethod
    def of_blocks(blocks: Sequence[Block], *, seconds: float = 20.0) -> History:
        """The last `seconds` of consecutive blocks of a run, (scenario, time), or all rows where there are fewer."""
        whole = Block.concatenate(list(blocks))
        dt = float(whole.time[1] - whole.time[0])
        part = whole[max(0, whole.time.shape[0] - round(seconds / dt) - 1) :]
        return History(dt, part.lead_speed, part.lead_accel, part.spacing[..., 0], part.speed[..., 0])

    @property
    def seconds(self) -> float:
        return (self.lead_speed.shape[1] - 1) * self.dt

    def __getitem__(self, index: Tensor) -> History:
        """Some of the scenarios."""
        return History(self.dt, self.lead_speed[index], self.lead_accel[index], self.spacing[index], self.speed[index])

    def thinned(self, stride: int) -> History:
        """Every `stride`-th row."""
        v, a = self.lead_speed[:, ::stride], self.lead_accel[:, ::stride]
        return History(stride * self.dt, v, a, self.spacing, self.speed)

    def leader(self) -> Leader:
        """The logged leader, (scenario, time), position from 0."""
        v = self.lead_speed
        moved = 0.5 * self.dt * (v[:, 1:] + v[:, :-1])
        position = torch.cat([torch.zeros_like(v[:, :1]), moved.cumsum(dim=1)], dim=1)
        time = torch.arange(v.shape[1], dtype=torch.float64) * self.dt
        return Leader(time, position, v, self.lead_accel, self.dt, "leader seen")


@torch.no_grad()
def replay(
    history: History,
    setting: Setting,
    *,
    T_L: Tensor,
    K_L: Tensor,
    time_gap_now: Tensor,
    accel_min: Number = -6.0,
    accel_max: Number = 4.0,
    standstill: float = 5.0,
    ramp_rate: float = RAMP_RATE,
    delay: float = 0.0,
    link_delay: float = 0.0,
    dt: float = 0.05,
) -> Performance:
    """Performance (scenario, candidate) of `setting` through `history`.

    `setting` (scenario, candidate), of a vehicle `T_L` [s], `K_L` [-] (scenario,). The time gap leaves `time_gap_now`
    (scenario,) after `delay` [s] at `ramp_rate` [s/s]; the leader's acceleration is received `link_delay` [s] late.
    Limits [m/s²] are numbers or (scenario,). The step is the logged one or a multiple of it, at most `dt` [s] and a
    sixth of the lag: holding a command for longer would make a fast car with a strong k_a oscillate, unlike the real
    loop.
    """
    strides = (torch.clamp_max(T_L / 6.0, dt) / history.dt + 1e-9).long().clamp(1, history.lead_speed.shape[1] - 1)

    def at_stride(stride: int, rows: Tensor) -> Performance:
        past, those = history[rows].thinned(stride), setting[rows]
        loop = ClosedLoop(
            past.leader(),
            plant=GLVDPlant(T_L[rows], K_L[rows], 0.0),
            scenarios=len(rows),
            spacing0=past.spacing.clamp_min(0.1),
            speed0=past.speed.clamp_min(0.0),
            link_delay=link_delay,
        )
        limits = {"accel_min": of_scenarios(accel_min, rows), "accel_max": of_scenarios(accel_max, rows)}
        parts: list[Performance] = []
        each = max(1, _ROWS // len(rows))
        for first in range(0, setting.shape[1], each):
            some = those[:, first : first + each].map(lambda _, x: x.transpose(0, 1))  # (candidate, scenario)
            twin = loop.copy(candidates=some.shape[0])
            start = Setting(time_gap=time_gap_now[rows], gains=some.gains).controller(standstill=standstill)
            twin.controller = some.retarget(start, at=delay, rate=ramp_rate)
            twin.lower_level = some.lower_level(**limits)
            run = twin.advance(past.lead_speed.shape[1])
            parts.append(performance(run, time_gap=some.time_gap, standstill=standstill))
        return _joined(parts).map(lambda x: x.mT)

    # The step follows from the scenario's own lag, so its prediction does not depend on the rest of the batch.
    groups = [(stride, torch.nonzero(strides == stride)[:, 0]) for stride in strides.unique().tolist()]
    whole = _joined([at_stride(stride, rows) for stride, rows in groups])
    order = torch.cat([rows for _, rows in groups]).argsort()
    return whole.map(lambda x: x[order])


def _joined(parts: Sequence[Performance]) -> Performance:
    return Performance(*(torch.cat(column) for column in zip(*(vars(p).values() for p in parts), strict=True)))


def of_scenarios(limit: Number, rows: Tensor) -> Number:
    """The limits of some of the scenarios, from one for all or one each."""
    return limit[rows] if isinstance(limit, Tensor) and limit.ndim else limit
