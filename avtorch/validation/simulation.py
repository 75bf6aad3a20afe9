"""Windows drawn from the exact model of the jerk likelihood, for checks that need both to agree.

``jerk_i ~ Normal((K_L u_i - a_i)/T_L, sigma^2)``, and ``a`` moves by the *measured* jerk, ``a + dt jerk``: then ``a``
carries no information about the vehicle beyond that of the jerk, and the likelihood of the jerk is that of all data. An
acceleration simulated without the noise would carry more information, and a posterior that does not use it would not be
exactly calibrated.
"""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.jerk import JerkStatistics
from avtorch.vehicle.glvd import glvd_jerk, glvd_rollout

Amplitude = float | tuple[float, float]
"""Of a command's first sine [m/s^2]: a number, or a range from which each window's is drawn evenly in the logarithm."""


def sine_commands(
    windows: int, rows: int, amplitude: Amplitude, *, dt: float = 0.01, generator: torch.Generator | None = None
) -> Tensor:
    """Two sines (2 and 5 rad/s, the second half as large) of random phases: demanded acceleration [m/s^2].

    `amplitude`: see :data:`Amplitude`. `dt`: sampling step [s].

    Returns:
        Shape ``(window, time)``.

    Raises `InputError` for an amplitude that is not positive, or a range that runs down.
    """
    low, high = amplitude if isinstance(amplitude, tuple) else (amplitude, amplitude)
    if not 0 < low <= high:
        raise InputError(f"amplitude: found {amplitude}, need a positive number or a rising range of them")
    phase = 2 * torch.pi * torch.rand(2, windows, 1, generator=generator, dtype=torch.float64)
    time = dt * torch.arange(rows, dtype=torch.float64)
    size = low * (high / low) ** torch.rand(windows, 1, generator=generator, dtype=torch.float64)
    return size * (torch.sin(2 * time + phase[0]) + 0.5 * torch.sin(5 * time + phase[1]))


def simulate_windows(
    z: Tensor, u: Tensor, *, dt: float = 0.01, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Acceleration [m/s^2] and jerk [m/s^3] of vehicles ``z = log(T_L, K_L, sigma)`` under commands ``u``.

    A lag below ``dt`` would diverge where a sample's jerk is held for ``dt``; it is held for ``T_L`` then.

    `z`: shape ``(window, 3)``. `u`: demanded acceleration [m/s^2], ``(window, time)``; the acceleration starts at the
    first command.

    Returns:
        ``a`` and ``jerk``, each ``(window, time)``.

    Raises `InputError` for shapes that do not match.
    """
    if z.ndim != 2 or z.shape[1] != 3 or u.ndim != 2 or len(u) != len(z):
        raise InputError(f"z, u: found shapes {tuple(z.shape)}, {tuple(u.shape)}, need (window, 3), (window, time)")
    lag, gain, sigma = z.exp().unbind(-1)
    noise = sigma[:, None] * torch.randn(u.shape, generator=generator, dtype=torch.float64)
    # noise in jerk is a command of T/K noise
    moved = glvd_rollout(u[:, 0], u + (lag / gain)[:, None] * noise, lag, gain, lag.clamp_max(dt), method="euler")
    a = torch.cat([u[:, :1], moved[:, :-1]], -1)
    return a, glvd_jerk(a, u, lag[:, None], gain[:, None]) + noise


def statistics(
    z: Tensor,
    *,
    rows: int = 200,
    amplitude: Amplitude = 1.0,
    dt: float = 0.01,
    generator: torch.Generator | None = None,
) -> JerkStatistics:
    """The six sums of one fresh window of every vehicle ``z``; arguments of `sine_commands`, `simulate_windows`."""
    u = sine_commands(len(z), rows, amplitude, dt=dt, generator=generator)
    a, jerk = simulate_windows(z, u, dt=dt, generator=generator)
    return JerkStatistics.from_samples(a, u, jerk)
