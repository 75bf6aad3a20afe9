"""Windows of the latent form drawn from their own law: parameters from the prior, rows from the model."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.inference.latent import LatentDensity, LatentWindow, default_noise_prior, latent_names
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, discretise, initial_covariance
from avtorch.inference.priors import Joint, default_actuation_prior


def drawn_window(
    generator: torch.Generator, *, accel: bool, speed: bool, rows: int, dt: float, jitter: float = 0.0
) -> tuple[LatentDensity, Tensor]:
    """A window's density and the parameters ``(parameter,)`` that it was drawn with.

    The command steps at random times. ``jitter``: a row's time is off its grid by up to this share of a step.
    """
    f64 = torch.float64
    names = latent_names(accel=accel, speed=speed)
    prior = Joint(default_actuation_prior(), default_noise_prior(names[2:]))
    truth = prior.sample(1, 1, generator=generator)[0, 0].exp()
    p = dict(zip(names, truth, strict=True))
    off = jitter * (2 * torch.rand(rows, dtype=f64, generator=generator) - 1)
    time = dt * (torch.arange(rows, dtype=f64) + off)
    levels = torch.randn(rows, dtype=f64, generator=generator)
    changes = torch.rand(rows, generator=generator) < dt / 0.5
    u = levels[changes.cumsum(0)]
    road = p.get("road_noise", torch.zeros((), dtype=f64))
    given = (p["T_L"], p["K_L"], p["process_noise"], road, p["coloured_sd"], p["coloured_time"])
    step = discretise(*given, time.diff())
    root = torch.linalg.cholesky(step.noise + 1e-18 * torch.eye(4, dtype=f64))
    start = initial_covariance(p["coloured_sd"], p["coloured_time"]).diagonal().sqrt()
    x = start * torch.randn(4, dtype=f64, generator=generator)
    states = [x]
    for k in range(rows - 1):
        noise = root[k] @ torch.randn(4, dtype=f64, generator=generator)
        x = step.transition[k] @ x + step.gain[k] * u[k] + noise
        states.append(x)
    path = torch.stack(states)

    def measured(row: tuple[float, ...], noise: str) -> Tensor:
        return path @ path.new_tensor(row) + p[noise] * torch.randn(rows, dtype=f64, generator=generator)

    a = measured(ACCEL_ROW, "accel_noise") if accel else None
    v = measured(SPEED_ROW, "speed_noise") if speed else None
    return LatentDensity(LatentWindow.single(time, u, accel=a, speed=v)), truth
