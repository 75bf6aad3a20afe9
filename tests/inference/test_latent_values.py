"""The compiled likelihood against the filter in torch, and what is differenced from its values."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from avtorch.inference.latent import LatentDensity, LatentWindow, compiled_log_likelihood, even_steps
from avtorch.inference.latent_model import latent_log_likelihood
from avtorch.inference.map import _from_values, find_mode
from tests.inference.latent_windows import drawn_window

TYPICAL = (0.3, 0.9, 0.15, 0.2, 1.5, 0.1, 0.03, 0.02)
CHANNELS = pytest.mark.parametrize("channels", ["speed", "accel", "both"])


def signals(channels: str, runs: int, rows: int, generator: torch.Generator) -> tuple[Tensor, dict[str, Tensor | None]]:
    u, noise = torch.randn(2, runs, rows, generator=generator, dtype=torch.float64)
    a = u.cumsum(-1) / 10 + noise / 10
    v = 8 + (0.02 * a).cumsum(-1) + noise / 30
    return u, {"accel": None if channels == "speed" else a, "speed": None if channels == "accel" else v}


def parameters(generator: torch.Generator, *shape: int) -> tuple[tuple[Tensor, ...], dict[str, Tensor]]:
    p = torch.tensor(TYPICAL, dtype=torch.float64)
    *five, accel, speed, road = (
        p * torch.exp(0.5 * torch.randn(*shape, 8, generator=generator, dtype=torch.float64))
    ).unbind(-1)
    return tuple(five), {"accel_noise": accel, "speed_noise": speed, "road_noise": road}


def named(five: tuple[Tensor, ...], noise: dict[str, Tensor]) -> dict[str, Tensor]:
    names = ("T_L", "K_L", "process_noise", "coloured_sd", "coloured_time")
    return dict(zip(names, five, strict=True)) | noise


@CHANNELS
@pytest.mark.parametrize("jitter", [0.0, 0.4, 1.9])
@pytest.mark.parametrize("draws", [1, 8, 19])
def test_compiled_values_equal_those_of_the_filter(channels: str, jitter: float, draws: int, fresh_seed: int) -> None:
    """Two runs of different lengths, as many parameters as fill their lanes, fewer, and more."""
    generator = torch.Generator().manual_seed(fresh_seed)
    u, measured = signals(channels, 2, 80, generator)
    steps = 0.02 * (1 + jitter * (torch.rand(2, 80, generator=generator, dtype=torch.float64) - 0.5))
    used = torch.ones(2, 80, dtype=torch.bool)
    used[1, 33:] = False
    runs = LatentWindow(steps.cumsum(-1), u, measured["accel"], measured["speed"], used)
    even = even_steps(runs) if jitter == 0 else None
    assert (even is None) == (jitter > 0)
    five, noise = parameters(generator, draws, 2)
    given = {name: x for name, x in noise.items() if channels == "both" or channels in name or name == "road_noise"}
    found = compiled_log_likelihood(named(five, given), runs, even)
    exact = latent_log_likelihood(*five, runs.time, u, mask=used, **measured, **noise)
    torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-8)


def test_compiled_values_of_a_single_row(fresh_seed: int) -> None:
    generator = torch.Generator().manual_seed(fresh_seed)
    u, measured = signals("both", 1, 1, generator)
    runs = LatentWindow(torch.zeros(1, 1, dtype=torch.float64), u, mask=torch.ones(1, 1, dtype=torch.bool), **measured)
    five, noise = parameters(generator, 3, 1)
    found = compiled_log_likelihood(named(five, noise), runs, None)
    exact = latent_log_likelihood(*five, runs.time, u, **measured, **noise)
    torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-8)


def test_compiled_values_say_where_there_is_none(fresh_seed: int) -> None:
    """Parameters that are no numbers give none, and leave the others as they are."""
    generator = torch.Generator().manual_seed(fresh_seed)
    u, measured = signals("both", 1, 50, generator)
    runs = LatentWindow(
        0.02 * torch.arange(50, dtype=torch.float64)[None], u, mask=torch.ones(1, 50, dtype=torch.bool), **measured
    )
    five, noise = parameters(generator, 9, 1)
    before = compiled_log_likelihood(named(five, noise), runs, even_steps(runs))
    five[0][4] = torch.nan
    after = compiled_log_likelihood(named(five, noise), runs, even_steps(runs))
    assert bool(after[4].isnan().all())
    others = torch.arange(9) != 4
    assert torch.equal(before[others], after[others])


def test_windows_are_what_they_are_alone(fresh_seed: int) -> None:
    """Uneven windows, one by one and stacked."""
    generator = torch.Generator().manual_seed(fresh_seed)
    u, measured = signals("both", 3, 40, generator)
    time = (0.02 * (1 + 0.8 * torch.rand(40, generator=generator, dtype=torch.float64))).cumsum(0).expand(3, -1)
    same = u[:1].expand(3, -1)
    windows = LatentWindow(time, same, measured["accel"], measured["speed"], torch.ones(3, 40, dtype=torch.bool))
    density = LatentDensity(windows)
    z = density.initial() + 0.1 * torch.randn(4, 3, len(density.names), generator=generator, dtype=torch.float64)
    with torch.no_grad():
        together = density.log_prob(z)
        alone = [LatentDensity(windows.select(torch.tensor([w]))).log_prob(z[:, [w]]) for w in range(3)]
    torch.testing.assert_close(together, torch.cat(alone, -1), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("jitter", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_derivatives_from_values_are_those_of_the_graph(jitter: float, fresh_seed: int) -> None:
    """Central differences ``h`` apart are off by ``h²/6`` of the third and ``h²/12`` of the fourth derivative, here of
    the order of the curvature, and by the values' round-off over ``h`` and over ``h²``."""
    generator = torch.Generator().manual_seed(fresh_seed)
    density, truth = drawn_window(generator, accel=True, speed=True, rows=60, dt=0.02, jitter=jitter)
    z = truth.log()[None]
    potential, gradient, hessian = _from_values(density, z)

    def of_graph(x: Tensor) -> Tensor:
        return -density.log_prob(x[None])[0]

    slope = torch.autograd.functional.jacobian(of_graph, z[0])
    bend = torch.autograd.functional.hessian(of_graph, z[0])
    assert isinstance(slope, Tensor)
    assert isinstance(bend, Tensor)
    scale = float(bend.abs().max())
    assert float((potential - of_graph(z[0])).abs().max()) < 1e-7
    assert float((gradient - slope).abs().max()) < 10 * 2e-3**2 * scale + 1e-4
    assert float((hessian - bend).abs().max()) < 10 * 2e-3**2 * scale + 0.05
    # those that a walk follows, from values nearer by
    assert float((density.score(z) + slope).abs().max()) < 10 * 1e-4**2 * scale + 1e-4


@dataclass
class Graphed:
    """A density of which nothing but its value is known, and that by a graph."""

    of: LatentDensity

    def __post_init__(self) -> None:
        self.names, self.windows, self.log_prob, self.initial = (
            self.of.names,
            self.of.windows,
            self.of.log_prob,
            self.of.initial,
        )


@pytest.mark.slow
def test_the_mode_from_values_is_the_mode(fresh_seed: int) -> None:
    generator = torch.Generator().manual_seed(fresh_seed)
    density, _ = drawn_window(generator, accel=True, speed=True, rows=100, dt=0.02)
    quick, exact = find_mode(density), find_mode(Graphed(density))
    off = torch.linalg.solve_triangular(exact.scale, (quick.z - exact.z)[..., None], upper=False)
    # a hundredth of an SD, a fifth of what 400 effective draws leave open
    assert float(off.norm()) < 1e-2
    assert bool(quick.converged.all())
