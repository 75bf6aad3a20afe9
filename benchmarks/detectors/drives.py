"""Drives with and without a change of the vehicle, and the belief after each of their windows.

The moment of the change differs from run to run, so that no detector profits from the leader's motion at that moment.
Beliefs are computed once per run; every detector gets the same ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.decision.divergence import Gaussian
from avtorch.decision.monitor import Monitor
from avtorch.decision.settings import Setting
from avtorch.inference import BeliefStream, SamplerSettings
from avtorch.io.log import STANDSTILL_MPS
from avtorch.vehicle import ClosedLoop, GLVDPlant, Leader

HEALTHY = (0.3, 1.0)
EARLIEST_S, LATEST_S = 40.0, 120.0
STEP_S = 0.5  # the vehicle may change this often; a change then mostly falls inside a window
SWING_S = 30.0
DRAWS_CHAINS = 128  # 1024 draws per window: their scatter adds a thousandth to the spread of a window's mean


@dataclass(frozen=True)
class Change:
    """The change of the vehicle: `to` (T_L [s], K_L [-]), reached in equal steps over `ramp_s` [s] (0: at once).

    `since_ever`: it is like that from the start, so that there is no change to detect. `swing`: the gain swings by this
    share over half a minute throughout, because no real car follows GLVD exactly. `noise`: of the jerk [m/s³].
    """

    name: str
    to: tuple[float, float]
    ramp_s: float = 0.0
    since_ever: bool = False
    swing: float = 0.0
    noise: float = 0.1


UNCHANGED = {
    c.name: c
    for c in (
        Change("healthy", HEALTHY, since_ever=True),
        Change("rough", HEALTHY, since_ever=True, noise=0.3),
        Change("off", (0.35, 0.95), since_ever=True),
        Change("uneven", HEALTHY, since_ever=True, swing=0.02),
    )
}
CHANGES = {
    c.name: c
    for c in (
        Change("abrupt", (1.5, 0.5)),
        Change("drift", (1.5, 0.5), ramp_s=60.0),
        Change("moderate", (0.45, 0.85)),
        Change("slight", (0.36, 0.95)),
    )
}


@dataclass(frozen=True)
class Beliefs:
    """The input of a detector, (window, run) each; `belief` mean (window, run, 2) and covariance of the logs.

    `used`: the window was excited and its chains converged. `p_stable`: P(string stable) under the default setting;
    `T_L`, `K_L`: posterior means; `sure`: what `accepted_change` compares. `end_s` (window,) and `change_s` (run,) [s].
    """

    end_s: Tensor
    change_s: Tensor
    used: Tensor
    p_stable: Tensor
    sure: Tensor
    belief: Gaussian
    collided: int

    @property
    def duration_s(self) -> float:
        return float(self.end_s[-1])


def drive(leader: Leader, change: Change, *, runs: int, first_seed: int, duration: float) -> Beliefs:
    """`runs` closed loops in one batch behind `leader`, and the belief about each after every 2 s."""
    generator = torch.Generator().manual_seed(first_seed)
    moments = torch.rand(runs, generator=generator, dtype=torch.float64)
    phase = torch.rand(runs, generator=generator, dtype=torch.float64)
    at = EARLIEST_S + STEP_S * torch.floor(moments * (LATEST_S - EARLIEST_S) / STEP_S)
    loop = ClosedLoop(leader, scenarios=runs, seeds=range(first_seed, first_seed + runs))
    stream = BeliefStream(
        window=2.0, vehicles=runs, gap=float("inf"), seed=first_seed, settings=SamplerSettings(chains=DRAWS_CHAINS)
    )
    watch, setting = Monitor(runs), Setting(scenarios=runs)
    rows: list[tuple[Tensor, ...]] = []
    ends: list[float] = []
    steps = round(STEP_S / loop.dt)
    while loop.time < duration - 1e-6:
        T_true, K_true = _vehicle(change, loop.time - at)
        wave = change.swing * torch.sin(2.0 * math.pi * (loop.time / SWING_S + phase))
        loop.plant = GLVDPlant(T_true, K_true * (1.0 + wave), change.noise)
        block = loop.advance(steps)
        columns = {"accel_cmd": block.accel_cmd, "accel": block.accel, "jerk": block.jerk}
        usable = (block.speed >= STANDSTILL_MPS) & ~loop.collided[:, None]
        for window in stream.feed(block.time, columns, usable=usable, until=loop.time):
            belief = window.belief
            T, K = (belief.draws[..., i].mT.double() for i in range(2))
            used = belief.excited & belief.converged
            report = watch.update(T, K, used, setting)
            log = Gaussian.of_draws(T, K)
            ends.append(window.end_s)
            statistics = report.statistics
            rows.append((used, statistics["stability"], statistics["accepted_change"], log.mean, log.cov))
    used, p, sure, mean, cov = (torch.stack(column) for column in zip(*rows, strict=True))
    end = torch.tensor(ends, dtype=torch.float64)
    return Beliefs(end, at, used, p, sure, Gaussian(mean, cov), int(loop.collided.sum()))


def _vehicle(change: Change, since: Tensor) -> tuple[Tensor, Tensor]:
    """T_L [s] and K_L [-] (run,) at `since` [s] after the change began."""
    if change.since_ever:
        share = torch.ones_like(since)
    else:
        share = (since >= -1e-9).double() if change.ramp_s == 0.0 else (since / change.ramp_s).clamp(0.0, 1.0)
    T, K = (old + share * (new - old) for old, new in zip(HEALTHY, change.to, strict=True))
    return T, K
