"""The paper's drive: a vehicle that changes at 26 s and gets a new setting at 28 s, for many settings and seeds in one
batch. And its protocol of estimation: windows of 5 s at 100 Hz, three to form a prior, seven more (Section 3.3)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from avtorch.decision.settings import Setting
from avtorch.inference import BeliefStream
from avtorch.inference.stream import Window
from avtorch.io.log import STANDSTILL_MPS
from avtorch.paper.leaders import SWEEP_S
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader
from avtorch.vehicle.block import Block

HEALTHY, CHANGED = (0.3, 1.0), (1.5, 0.5)
"""(T_L [s], K_L [-]) before and after the change (paper, Table 1 and Section 4)."""

ESTIMATED = (1.33, 0.64)
"""The paper's estimates after the change, which it puts into its lower level (Section 4, Strategy 1)."""

CHANGE_S, ACT_S = 26.0, 28.0

NOISE = 0.1
"""Jerk noise [m/s³]; the paper gives none (SPEC section 1)."""

WINDOW_S = 5.0
FOR_PRIOR, MORE = 3, 7

Progress = Callable[[float], None]
"""Called with the share of an experiment that is done, 0 to 1."""


def noise_seeds(seed: int, count: int) -> list[int]:
    """`count` seeds of jerk noise, none shared by two neighbouring `seed`s."""
    return [(seed * 1_000_003 + i) % 2**62 for i in range(count)]


def change(loop: ClosedLoop) -> None:
    """The change of the vehicle at 26 s."""
    loop.plant = GLVDPlant(*CHANGED, sigma=NOISE)


def drive(
    leader: Leader,
    settings: Setting,
    *,
    seeds: int,
    seed: int,
    duration: float,
    vehicles: int | None = None,
    noise: float = NOISE,
    progress: Progress | None = None,
) -> Block:
    """Simulate each of `settings` (setting,), in force from 28 s, under the same `seeds` noises; before, the vehicle of
    Table 1.

    The time gap moves there at the loop's own rate, gains and lower level at once. Returns rows (setting, seed, time),
    with `vehicles` (setting, seed, vehicle, time).
    """
    count = len(settings.time_gap)
    each: Setting = settings[torch.arange(count).repeat_interleave(seeds)]
    loop = ClosedLoop(
        leader,
        plant=GLVDPlant(*HEALTHY, sigma=noise),
        scenarios=count * seeds,
        seeds=noise_seeds(seed, seeds) * count,
        vehicles=vehicles,
    )
    blocks = [_advance(loop, CHANGE_S, duration, progress)]
    loop.plant = GLVDPlant(*CHANGED, sigma=noise)
    blocks.append(_advance(loop, ACT_S, duration, progress))
    loop.controller = each.retarget(loop.controller, at=ACT_S)
    loop.lower_level = each.lower_level()
    blocks.append(_advance(loop, duration, duration, progress))
    whole = Block.concatenate(blocks)
    rows = {name: x.unflatten(0, (count, seeds)) for name, x in vars(whole).items() if name != "time"}
    return Block(whole.time, **rows)


def ten_windows(
    leader: Leader, T_L: Tensor, K_L: Tensor, *, seed: int, progress: Progress
) -> tuple[list[Window], list[Tensor]]:
    """Vehicles T_L [s], K_L [-] (run,) behind `leader`, each with its own noise and its own belief.

    The nominal controller drives, its demand passed through. Returns the ten windows and, of each, the RMS of the
    command (run,) [m/s²].
    """
    runs = len(T_L)
    loop = ClosedLoop(leader, plant=GLVDPlant(T_L, K_L, sigma=NOISE), scenarios=runs, seeds=noise_seeds(seed, runs))
    stream = BeliefStream(window=WINDOW_S, vehicles=runs, seed=seed, check_units=False)
    windows: list[Window] = []
    asked: list[Tensor] = []
    while loop.time < SWEEP_S - 1e-9:
        block = loop.advance(round(WINDOW_S / loop.dt))
        columns = {name: getattr(block, name) for name in stream.form.columns}
        moving = block.speed >= STANDSTILL_MPS
        windows += stream.feed(block.time, columns, usable=moving, until=loop.time)
        asked.append(block.accel_cmd.square().mean(-1).sqrt())
        progress(loop.time / SWEEP_S)
    return windows, asked


def stacked(settings: list[Setting]) -> Setting:
    """Settings of shape (1,) as one of shape (setting,)."""
    return settings[0].map(lambda name, _: torch.cat([getattr(s, name) for s in settings]))


def rows_from(run: Block, start: float, end: float | None = None) -> Block:
    """The rows from `start` to `end` [s]."""
    first = int(torch.searchsorted(run.time, start - 1e-6))
    last = len(run.time) if end is None else int(torch.searchsorted(run.time, end - 1e-6))
    return run[first:last]


def _advance(loop: ClosedLoop, until: float, duration: float, progress: Progress | None) -> Block:
    """Advance to `until` [s], in pieces so that progress can be reported."""
    end, blocks = round(until / loop.dt), []
    while loop.steps_done < end:
        blocks.append(loop.advance(min(1000, end - loop.steps_done)))
        if progress is not None:
            progress(loop.time / duration)
    return Block.concatenate(blocks)
