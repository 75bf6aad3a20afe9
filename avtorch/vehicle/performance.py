"""Measures of a run: comfort, safety, stability and throughput, by scenario."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.vehicle.arguments import Batched, Number, checked, tensor
from avtorch.vehicle.block import Block

#: Bounds of comfort: 2 m/s² and, as ISO 15622 asks of adaptive cruise control, 2.5 m/s³.
COMFORT_ACCEL, COMFORT_JERK = 2.0, 2.5

#: Road load per unit mass of a mid-size car: rolling 0.01 g, and rho c_d A / (2 m) = 1.2 * 0.65 / (2 * 1500).
ROLLING_MPS2, AERO_PER_M = 0.0981, 2.6e-4

#: Braking for the safe spacing: both cars at most 6 m/s², the lower level's limit; the follower half a second later.
BRAKING_MPS2, REACTION_S = 6.0, 0.5

VEHICLE_LENGTH_M = 4.5


@dataclass(frozen=True)
class Performance:
    """Tensors (scenario,), in a platoon (scenario, vehicle), float64.

    - `speed_rms_ratio` [-]: RMS of the follower's speed about its mean over that of the leader (without removing the
      mean the ratio would always be near 1); `accel_rms_ratio` [-]: RMS acceleration over the leader's. Above 1 the
      follower amplifies. NaN behind a leader at constant speed. In a platoon against the vehicle in front; the product
      over the vehicles is tail against head.
    - `min_spacing_m`: zero or less means a collision. `min_ttc_s`: least spacing / closing speed over rows that close
      in; infinite if none does, 0 after a collision. `safe_share`: rows from which the follower could still stop behind
      a leader who brakes at 6 m/s², if it does so itself half a second later (Shalev-Shwartz et al. 2017, without the
      acceleration meanwhile).
    - `jerk_rms_mps3`: of the instantaneous jerk, noise included. `clipped_share`: rows whose command hit the limits.
    - `comfort_share`: rows within 2 m/s² and 2.5 m/s³. `energy_jpkgm`: positive traction work per kg and metre driven
      (acceleration, rolling, air; no recuperation). `throughput_vph`: vehicles an hour at equilibrium at the mean speed
      of the leader, NaN without a time gap.
    """

    speed_rms_ratio: Float[Tensor, "*scenario"]
    accel_rms_ratio: Float[Tensor, "*scenario"]
    min_spacing_m: Float[Tensor, "*scenario"]
    min_ttc_s: Float[Tensor, "*scenario"]
    safe_share: Float[Tensor, "*scenario"]
    jerk_rms_mps3: Float[Tensor, "*scenario"]
    clipped_share: Float[Tensor, "*scenario"]
    comfort_share: Float[Tensor, "*scenario"]
    energy_jpkgm: Float[Tensor, "*scenario"]
    throughput_vph: Float[Tensor, "*scenario"]

    def map(self, change: Callable[[Tensor], Tensor]) -> Performance:
        """`change` of every measure."""
        return Performance(*(change(getattr(self, f.name)) for f in fields(self)))

    def row(self, *index: int) -> dict[str, float | None]:
        """One scenario's (or vehicle's) figures by name; a number that is not finite is None, for JSON."""
        out: dict[str, float | None] = {}
        for f in fields(self):
            value = float(getattr(self, f.name)[index or (0,)].reshape(-1)[0])
            out[f.name] = value if math.isfinite(value) else None
        return out


def performance(run: Block, *, time_gap: Number | None = None, standstill: Number = 5.0) -> Performance:
    """Compute the measures of a `Block` or `Trajectory` (..., time).

    `time_gap` [s] is that of the setting, for the throughput; `standstill` [m] likewise. The peak gain
    belongs to a setting, not to a run: `avtorch.stability.peak_gain`.

    Example:
        >>> from avtorch import GLVDPlant, Leader, performance, simulate
        >>> leader = Leader.default(start=180.0, duration=40.0, dt=0.05)
        >>> cars = [GLVDPlant(T_L=0.3, K_L=1.0, sigma=0.0), GLVDPlant(T_L=1.5, K_L=0.5, sigma=0.0)]
        >>> [round(float(performance(simulate(leader, plant=car)).accel_rms_ratio), 2) for car in cars]
        [0.85, 1.14]
    """
    v, a, lead_v, lead_a = run.speed, run.accel, run.lead_speed, run.lead_accel
    dt = float(run.time[1] - run.time[0]) if len(run.time) > 1 else math.nan
    closing = v - lead_v
    ttc = torch.where(closing > 0, run.spacing / torch.where(closing > 0, closing, 1.0), math.inf)
    needed = REACTION_S * v + torch.clamp(v * v - lead_v * lead_v, min=0.0) / (2.0 * BRAKING_MPS2)
    traction = torch.clamp(a + ROLLING_MPS2 + AERO_PER_M * v * v, min=0.0) * v
    mean = lead_v.mean(-1)
    flow = torch.full_like(mean, math.nan)
    if time_gap is not None:
        flow = equilibrium_throughput(mean, time_gap, standstill=standstill).expand(mean.shape)
    calm = (a.abs() <= COMFORT_ACCEL) & (run.jerk.abs() <= COMFORT_JERK)
    return Performance(
        speed_rms_ratio=rms_about_mean(v) / _moving(rms_about_mean(lead_v)),
        accel_rms_ratio=rms(a) / _moving(rms(lead_a)),
        min_spacing_m=run.spacing.amin(-1),
        min_ttc_s=ttc.amin(-1).clamp(min=0.0),
        safe_share=(run.spacing >= needed).to(v.dtype).mean(-1),
        jerk_rms_mps3=rms(run.jerk),
        clipped_share=run.clipped.to(v.dtype).mean(-1),
        comfort_share=calm.to(v.dtype).mean(-1),
        energy_jpkgm=(traction.sum(-1) * dt) / (v.sum(-1) * dt),
        throughput_vph=flow,
    )


def equilibrium_throughput(speed: Batched, time_gap: Batched, *, standstill: Batched = 5.0) -> Float[Tensor, "*batch"]:
    """Vehicles an hour past a point when all drive at `speed` [m/s] and `time_gap` [s]; arguments broadcast.

    `3600 v / (time_gap v + standstill + 4.5 m)`. Raises `InputError` for negative values.
    """
    v, gap = checked("speed", speed, unit="m/s", least=0.0), checked("time_gap", time_gap, unit="s", least=0.0)
    return 3600 * v / (gap * v + tensor(standstill) + VEHICLE_LENGTH_M)


def rms(x: Float[Tensor, "*scenario time"]) -> Float[Tensor, "*scenario"]:
    """Root mean square over time, the last dimension."""
    return x.square().mean(-1).sqrt()


def rms_about_mean(x: Float[Tensor, "*scenario time"]) -> Float[Tensor, "*scenario"]:
    """Root mean square about the mean over time, the last dimension."""
    return rms(x - x.mean(-1, keepdim=True))


def _moving(x: Tensor) -> Tensor:
    """NaN where the leader shows no motion to compare with (rounding apart)."""
    return torch.where(x > 1e-9, x, math.nan)
