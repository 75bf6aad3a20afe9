"""A follower behind a recorded-like leader, its law and plant known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from avtorch.follower import LAWS, FollowerMeasurements, HeadwayLaw
from avtorch.gap import DeadTime, plant
from avtorch.io import Log
from avtorch.vehicle import ClosedLoop, FollowerState, Leader

CTG = {"spacing_gain_per_s2": 0.12, "speed_gain_per_s": 0.5, "time_gap_s": 1.5, "standstill_m": 3.0}
IDM = {
    "max_accel_mps2": 1.2,
    "comfort_brake_mps2": 2.0,
    "time_gap_s": 1.4,
    "standstill_m": 2.5,
    "desired_speed_mps": 36.0,
}
T_L, DELAY = 0.4, 0.3
DT = 0.1


def leader(seconds: float, rng: np.random.Generator) -> Leader:
    """A leader whose speed wanders between some 12 and 26 m/s."""
    time = torch.arange(round(seconds / DT) + 1, dtype=torch.float64) * DT
    accel = torch.zeros_like(time)
    for period in (47.0, 23.0, 11.0, 6.0):
        accel += 0.3 * torch.sin(2 * torch.pi * (time / period + float(rng.random())))
    speed = 19 + torch.cumsum(accel, 0) * DT
    speed = speed - speed.mean() + 19
    position = torch.cumsum(speed, 0) * DT
    return Leader(time, position, speed, accel, DT)


def controller(
    law: HeadwayLaw, values: dict[str, float], overrides: Sequence[tuple[float, float]] = ()
) -> Callable[[FollowerState], torch.Tensor]:
    """The law; in `overrides` (begin, end) [s] a driver brakes, and the law asks for more as the gap opens."""
    own = {k: torch.tensor(v, dtype=torch.float64) for k, v in values.items()}

    def command(s: FollowerState) -> torch.Tensor:
        asked = law.command(own, FollowerMeasurements(s.spacing, s.speed, s.lead_speed))
        driven = any(begin <= s.time < end for begin, end in overrides)
        return torch.full_like(asked, -0.6) if driven else asked

    return command


def followed_log(
    name: str,
    values: dict[str, float],
    *,
    seconds: float,
    rng: np.random.Generator,
    noise: float = 0.15,
    overrides: Sequence[tuple[float, float]] = (),
) -> Log:
    """What a follower would log, without its commands: jerk noise `noise` [m/s³], sensors' noise on both signals.

    `overrides`: as of `controller`, with `engaged` 0 there.
    """
    law = LAWS[name]
    ahead = leader(seconds, rng)
    v0 = float(ahead.speed[0])
    start = float(law.spacing({k: torch.tensor(x, dtype=torch.float64) for k, x in values.items()}, v0))
    car = plant([DeadTime(DELAY)], T_L=T_L, K_L=1.0, sigma=noise)
    loop = ClosedLoop(
        ahead,
        controller(law, values, overrides),
        plant=car,
        speed0=v0,
        spacing0=start,
        scenarios=1,
        seeds=[int(rng.integers(1 << 30))],
    )
    block = loop.advance(len(ahead.time) - 1)
    rows = len(block.time)
    driven = np.zeros(rows, bool)
    for begin, end in overrides:
        driven |= ((block.time >= begin) & (block.time < end)).numpy()
    return Log.from_arrays(
        name=f"{name} drive",
        time=block.time.numpy(),
        speed=block.speed[0].numpy() + 0.01 * rng.standard_normal(rows),
        spacing=block.spacing[0].numpy() + 0.02 * rng.standard_normal(rows),
        lead_speed=ahead.speed[:rows].numpy() + 0.01 * rng.standard_normal(rows),
        engaged=(~driven).astype(float),
        following=True,
    )
