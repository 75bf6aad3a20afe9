"""Second-order lags by SGLD: coverage of truths drawn from the prior, and distance from quadrature.

``python -m benchmarks.second_order [--vehicles 1000] [--exact 40] [--seed 20261122]``

A speed command, or a position command, of two sines around 15 m/s; 200 rows at 20 Hz; lag, gain or damping, and noise
on the acceleration from the default priors. The seed was fixed before the first run.
"""

from __future__ import annotations

import argparse
import math

import torch
from torch import Tensor

from avtorch.inference import (
    PositionLagDensity,
    SpeedLagDensity,
    default_position_lag_prior,
    default_speed_lag_prior,
    integrate,
    sample,
)
from avtorch.vehicle.second_order import PositionLag, SpeedLag, position_lag_accel, speed_lag_accel

SEED = 20261122
PRIOR = {"speed": default_speed_lag_prior, "position": default_position_lag_prior}
LEVELS = (0.5, 0.9, 0.95)


def vehicles_of(kind: str, count: int, g: torch.Generator) -> Tensor:
    """Truths of the default prior, ``(vehicle, 3)``: ``(T_V, K_V, sigma)`` or ``(T_P, zeta, sigma)``."""
    actuation = PRIOR[kind]().sample(1, count, generator=g)[0].exp()
    return torch.cat([actuation, torch.randn(count, 1, generator=g, dtype=torch.float64).abs()], -1)


def drive(
    kind: str, truth: Tensor, g: torch.Generator, *, rows: int = 200, dt: float = 0.05
) -> tuple[Tensor, dict[str, Tensor]]:
    """Time and columns ``(vehicle, time)`` of vehicles ``truth`` ``(vehicle, 3)``, a row every ``dt`` [s]."""
    T, second, sigma = truth.unbind(-1)
    time = dt * torch.arange(rows, dtype=torch.float64)
    phase = 6.28 * torch.rand(2, len(truth), 1, generator=g, dtype=torch.float64)
    swing = 1.5 * torch.sin(0.6 * time + phase[0]) + 0.7 * torch.sin(1.9 * time + phase[1])
    noise = sigma[:, None] * torch.randn(len(truth), rows, generator=g, dtype=torch.float64)
    if kind == "speed":
        v_cmd = 15 + swing
        v = _from_start(second * v_cmd[:, 0], SpeedLag(T, second).rollout(second * v_cmd[:, 0], v_cmd, dt))
        accel = speed_lag_accel(v, v_cmd, T[:, None], second[:, None]) + noise
        return time, {"speed_cmd": v_cmd, "speed": v, "accel": accel}
    x_cmd = 15 * time + 3 * swing
    # begun at the distance that a steady 15 m/s leaves
    x0, v0 = x_cmd[:, 0] - 30 * second * T, torch.full_like(T, 15.0)
    later = PositionLag(T, second).rollout(x0, v0, x_cmd, dt)
    x, v = _from_start(x0, later[0]), _from_start(v0, later[1])
    accel = position_lag_accel(x_cmd - x, v, T[:, None], second[:, None]) + noise
    return time, {"position_cmd": x_cmd, "position": x, "speed": v, "accel": accel}


def _from_start(start: Tensor, later: Tensor) -> Tensor:
    return torch.cat([start[:, None], later[:, :-1]], -1).detach()


def density_of(kind: str, columns: dict[str, Tensor]) -> SpeedLagDensity | PositionLagDensity:
    """The posterior of every vehicle's rows under the default prior."""
    if kind == "speed":
        return SpeedLagDensity(SpeedLagDensity.sums(columns["speed"], columns["speed_cmd"], columns["accel"]))
    error = columns["position_cmd"] - columns["position"]
    return PositionLagDensity(PositionLagDensity.sums(error, columns["speed"], columns["accel"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--exact", type=int, default=40, help="vehicles that quadrature is asked for")
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    for kind in PRIOR:
        g = torch.Generator().manual_seed(options.seed)
        truth = vehicles_of(kind, options.vehicles, g)
        density = density_of(kind, drive(kind, truth, g)[1])
        found = sample(density, generator=g)
        used = found.converged
        print(f"{kind} command: {options.vehicles} vehicles, {int((~used).sum())} not converged, seed {options.seed}")
        for level in LEVELS:
            low, high = found.quantile(0.5 - level / 2), found.quantile(0.5 + level / 2)
            shares = ((low <= truth) & (truth <= high))[used].double().mean(0)
            coverage = ", ".join(
                f"{name} {100 * x:.1f}" for name, x in zip(density.names, shares.tolist(), strict=True)
            )
            error = 100 * math.sqrt(level * (1 - level) / int(used.sum()))
            print(f"  {level:.0%} interval covers [%]: {coverage}; binomial error {error:.1f}", flush=True)
        some = torch.arange(options.exact)
        exact = integrate(density.select(some))
        good = used[some] & exact.converged
        off = ((found.mean[some] - exact.mean).abs() / exact.sd)[good]
        ratio = (found.sd[some] / exact.sd)[good]
        print(
            f"  against quadrature, {int(good.sum())} vehicles: means off by at most {float(off.max()):.3f} SD, "
            f"SD ratio {float(ratio.min()):.3f} to {float(ratio.max()):.3f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
