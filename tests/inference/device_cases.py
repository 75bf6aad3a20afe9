"""Rows and densities on any device, for the tests of an emulated one and of a graphics card."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Gamma, constraints

from avtorch.inference import (
    JerkDensity,
    JerkPoints,
    JerkStatistics,
)
from avtorch.inference.latent import LatentDensity, LatentWindow
from avtorch.inference.priors import (
    Joint,
    LogSpaceNormal,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
)
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout
from benchmarks.torch_density import TorchDensity

F64 = torch.float64


def rows(vehicles: int = 2, count: int = 400, seed: int = 0) -> tuple[Tensor, dict[str, Tensor]]:
    """Time and columns (vehicle, time) at 100 Hz, on the processor."""
    g = torch.Generator().manual_seed(seed)
    time = torch.arange(count, dtype=F64) / 100
    u = torch.stack([torch.sin(2 * time + k) + 0.5 * torch.sin(5 * time) for k in range(vehicles)])
    lag, gain = 0.4 + 0.3 * torch.arange(vehicles, dtype=F64), 0.9 * torch.ones(vehicles, dtype=F64)
    later = glvd_rollout(torch.zeros(vehicles, dtype=F64), u, lag, gain, 0.01)
    a = torch.cat([torch.zeros(vehicles, 1, dtype=F64), later[:, :-1]], -1)
    noise = torch.randn(3, *a.shape, dtype=F64, generator=g)
    jerk = glvd_jerk(a, u, lag[:, None], gain[:, None]) + 0.1 * noise[0]
    speed = 20 + 0.01 * a.cumsum(-1) + 0.01 * noise[1]
    return time, {"accel_cmd": u, "accel": a + 0.02 * noise[2], "jerk": jerk, "speed": speed}


def jerk_density(device: Any, which: str = "first") -> JerkDensity:
    _, c = rows()
    sums = JerkStatistics.from_samples(*(c[name].to(device) for name in ("accel", "accel_cmd", "jerk")))
    mean = torch.tensor([[0.5, 0.9], [0.6, 0.8]], dtype=F64)
    wide = LogSpaceNormal(torch.zeros(2, 3, dtype=F64), 0.5 * torch.eye(3, dtype=F64).repeat(2, 1, 1))
    quadrant = Joint(QuadrantNormal(mean, 0.25), default_jerk_noise_prior())
    first = Joint(default_actuation_prior(), default_jerk_noise_prior())
    switch = Switch(torch.tensor([True, False]), first, quadrant)
    return JerkDensity(sums, {"first": None, "wide": wide, "quadrant": quadrant, "switch": switch}[which])


def jerk_points(device: Any) -> JerkPoints:
    _, c = rows()
    return JerkPoints(*(c[name].to(device) for name in ("accel", "accel_cmd", "jerk")))


def latent_density(device: Any, jitter: float = 0.0) -> LatentDensity:
    time, c = rows(count=120)
    shaken = time + jitter * torch.rand(len(time), dtype=F64, generator=torch.Generator().manual_seed(1))
    data = LatentWindow(
        shaken.expand(2, -1), *(c[name][:, :120] for name in ("accel_cmd", "accel", "speed")),
        torch.ones(2, 120, dtype=torch.bool),
    )  # fmt: skip
    return LatentDensity(data.to(device))


def own(device: Any) -> TorchDensity:
    shape, rate = (torch.tensor(x, dtype=F64).to(device) for x in (9.0, 3.0))
    return TorchDensity(
        lambda p: Gamma(shape, rate, validate_args=False).log_prob(p["rate"]),
        {"rate": constraints.positive}, start={"rate": 2.0}, device=device,
    )  # fmt: skip


DENSITIES: dict[str, Callable[[Any], Any]] = {
    **{f"jerk, {prior}": lambda d, prior=prior: jerk_density(d, prior) for prior in ("first", "wide", "quadrant")},
    "jerk, switch": lambda d: jerk_density(d, "switch"),
    "points": jerk_points,
    "even rows": latent_density,
    "uneven rows": lambda d: latent_density(d, 0.008),
    "own": own,
}


def same(found: Any, expected: Any, rtol: float = 1e-9) -> None:
    """Tensors elsewhere against those on the processor."""
    assert found.device.type != "cpu"
    torch.testing.assert_close(found.cpu(), expected, rtol=rtol, atol=rtol, equal_nan=True)
