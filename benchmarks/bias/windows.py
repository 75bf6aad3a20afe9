"""The windows of the bias table, with their exact posteriors."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from avtorch.inference import JerkPoints, Mode, Quadrature, find_mode, integrate
from avtorch.validation.windows import simulate_windows

#: Amplitude of the command [m/s^2]: weak, medium and strong excitation.
AMPLITUDES = (0.1, 0.5, 2.0)
#: ``(T_L [s], K_L)`` of the vehicles, each driven with every amplitude; jerk noise 0.1 m/s^3, 100 Hz.
VEHICLES = ((0.15, 1.0), (0.3, 1.0), (0.7, 0.7), (1.5, 0.5))
NOISE = 0.1


@dataclass(frozen=True)
class Problem:
    """Windows of one length: the density point by point, its mode, and the truth by quadrature.

    ``strength`` ``(window,)`` is the number of the amplitude, 0 weak to 2 strong.
    """

    points: int
    density: JerkPoints
    mode: Mode
    truth: Quadrature
    strength: torch.Tensor


def problem(points: int, *, vehicles: int = len(VEHICLES), seed: int = 0) -> Problem:
    """Every vehicle behind a command of two sines (2 and 5 rad/s, the second half as large) of every amplitude."""
    g = torch.Generator().manual_seed(seed)
    pairs = [(k, car) for k in range(len(AMPLITUDES)) for car in VEHICLES[-vehicles:]]
    z = torch.tensor([(*car, NOISE) for _, car in pairs], dtype=torch.float64).log()
    strength = torch.tensor([k for k, _ in pairs])
    phase = 2 * torch.pi * torch.rand(2, len(pairs), 1, generator=g, dtype=torch.float64)
    time = 0.01 * torch.arange(points, dtype=torch.float64)
    size = torch.tensor(AMPLITUDES, dtype=torch.float64)[strength, None]
    u = size * (torch.sin(2 * time + phase[0]) + 0.5 * torch.sin(5 * time + phase[1]))
    a, jerk = simulate_windows(z, u, generator=g)
    density = JerkPoints(a, u, jerk)
    mode = find_mode(density)
    truth = integrate(density, mode=mode)
    assert bool((mode.converged & truth.converged).all()), "the reference must hold in every window"
    return Problem(points, density, mode, truth, strength)
