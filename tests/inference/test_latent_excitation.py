"""The excitation rule of the latent form: silent commands rejected, steps accepted, measured values never used."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from avtorch.inference.latent import REFERENCE_NOISE, LatentDensity, LatentWindow, latent_excitation

TIME = 0.01 * torch.arange(1000, dtype=torch.float64)


def window(u: Tensor, **more: Tensor) -> LatentWindow:
    return LatentWindow.single(TIME, u, speed=TIME, **more)


@pytest.mark.parametrize("size", [0.0, 0.1, 1.0, 2.0])
def test_constant_command_is_uninformative(size: float) -> None:
    excited, bits = latent_excitation(window(torch.full_like(TIME, size)))
    assert not bool(excited.any())
    assert float(bits) < 1e-3


def test_steps_excite_and_cruise_does_not() -> None:
    steps = torch.where(TIME % 4 < 2, 1.0, -1.0).to(torch.float64)
    cruise = 0.05 * torch.sin(2 * math.pi * TIME / 10)
    excited, bits = latent_excitation(LatentWindow.stack([window(steps), window(cruise), window(0.1 * steps)]))
    assert excited[:2].tolist() == [True, False]
    assert float(bits[0]) > float(bits[2]) > float(bits[1])


def test_measured_values_do_not_matter() -> None:
    u = torch.sin(TIME)
    first = latent_excitation(LatentWindow.single(TIME, u, speed=torch.cos(7 * TIME)))[1]
    assert torch.equal(first, latent_excitation(window(u))[1])


def test_masked_rows_and_noise_cost_information() -> None:
    u = torch.sin(TIME)
    _, all_rows = latent_excitation(window(u))
    _, half = latent_excitation(window(u, mask=TIME < 5))
    _, noisy = latent_excitation(window(u), noise={"coloured_sd": 0.5})
    assert float(half) < float(all_rows)
    assert float(noisy) < float(all_rows)


@pytest.mark.slow
def test_information_is_the_curvature_of_the_likelihood() -> None:
    """On the noise-free response the likelihood's Hessian in log K_L is the Fisher information, up to the slope.

    A command of mean zero has next to nothing in common with a constant force, so the rule must promise about as much.
    """
    u = torch.sin(2 * math.pi * TIME / 2)
    # the exact response at T_L = 0.3, K_L = 1 to the held command
    decay = math.exp(-0.01 / 0.3)
    a, v, speeds = u[0], torch.tensor(0.0, dtype=torch.float64), []
    for command in u:
        speeds.append(v)
        v = v + 0.01 * command + 0.3 * (1 - decay) * (a - command)
        a = command + decay * (a - command)
    data = LatentWindow.single(TIME, u, speed=torch.stack(speeds))
    density = LatentDensity(data)
    values = {"T_L": 0.3, "K_L": 1.0} | REFERENCE_NOISE
    z = torch.tensor([values[name] for name in density.names], dtype=torch.float64).log()

    def of_log_gain(x: Tensor) -> Tensor:
        return density.log_likelihood(torch.cat((z[:1], x, z[2:]))[None])[0]

    hessian = torch.autograd.functional.hessian(of_log_gain, z[1:2])
    assert isinstance(hessian, Tensor)
    curvature = -float(hessian)
    _, bits = latent_excitation(data)
    _, silent = latent_excitation(data, reference=(0.3, 1e-9))
    gain_alone = 0.5 * math.log2(1 + 0.3**2 * curvature)
    assert float(silent) < 1e-6
    assert 0.8 * gain_alone < float(bits)


def test_recorded_lap_has_both_kinds(data_dir: Path) -> None:
    """Lap 1: full throttle, a quiet stretch (10 to 20 s), then braking and a sprint."""
    lines = (data_dir / "genesis" / "lap1.csv").read_text().splitlines()[1:]
    table = torch.tensor([[float(x) for x in line.split(",")] for line in lines], dtype=torch.float64)
    time, u, speed = table.unbind(1)
    cut = [(time >= start) & (time < start + 10) for start in (0, 10, 20, 30, 40)]
    windows = [LatentWindow.single(time[c], u[c], speed=speed[c]) for c in cut]
    excited, _ = latent_excitation(LatentWindow.stack(windows))
    assert excited.tolist() == [True, False, True, True, True]
