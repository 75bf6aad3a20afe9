"""Windows under two sines, of vehicles given or drawn: what calibration is checked on."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import JerkStatistics
from avtorch.validation.windows import simulate_windows

ROWS = 200
"""Of a window, 10 ms each."""
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


def statistics(
    z: Tensor,
    *,
    rows: int = ROWS,
    amplitude: Amplitude = 1.0,
    dt: float = 0.01,
    generator: torch.Generator | None = None,
) -> JerkStatistics:
    """The six sums of one fresh window of every vehicle ``z``; arguments of `sine_commands`, `simulate_windows`."""
    u = sine_commands(len(z), rows, amplitude, dt=dt, generator=generator)
    a, jerk = simulate_windows(z, u, dt=dt, generator=generator)
    return JerkStatistics.from_samples(a, u, jerk)
