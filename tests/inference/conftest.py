"""Windows of measured jerk with a known truth, from hardly to well excited."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from avtorch.inference import JerkStatistics
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout

F64 = torch.float64


@dataclass(frozen=True)
class Windows:
    """``a, u, jerk`` of shape ``(window, time)`` at 100 Hz, behind a command of two sines of the given amplitudes."""

    a: Tensor
    u: Tensor
    jerk: Tensor

    @property
    def statistics(self) -> JerkStatistics:
        return JerkStatistics.from_samples(self.a, self.u, self.jerk)

    @property
    def time(self) -> Tensor:
        return 0.01 * torch.arange(self.a.shape[1], dtype=F64)

    @property
    def columns(self) -> dict[str, Tensor]:
        return {"accel_cmd": self.u, "accel": self.a, "jerk": self.jerk}


@pytest.fixture(scope="session")
def make_windows() -> Callable[..., Windows]:
    """``make_windows(seed, amplitude=[...], T=.., K=.., sigma=.., rows=200)``; one window an amplitude [m/s^2]."""

    def make(
        seed: int,
        amplitude: list[float],
        *,
        T: float | list[float] = 0.3,
        K: float | list[float] = 1.0,
        sigma: float = 0.1,
        rows: int = 200,
    ) -> Windows:
        g = torch.Generator().manual_seed(seed)
        size = torch.tensor(amplitude, dtype=F64)[:, None]
        lag, gain = (torch.as_tensor(x, dtype=F64).expand(len(amplitude)) for x in (T, K))
        time = 0.01 * torch.arange(rows, dtype=F64)
        phase = 6.28 * torch.rand(2, len(amplitude), 1, generator=g, dtype=F64)
        u = size * (torch.sin(2.0 * time + phase[0]) + 0.5 * torch.sin(5.0 * time + phase[1]))
        a0 = 0.5 * u[:, 0]
        later = glvd_rollout(a0, u, lag, gain, 0.01)
        a = torch.cat([a0[:, None], later[:, :-1]], -1)
        noise = sigma * torch.randn(u.shape, generator=g, dtype=F64)
        return Windows(a, u, glvd_jerk(a, u, lag[:, None], gain[:, None]) + noise)

    return make
