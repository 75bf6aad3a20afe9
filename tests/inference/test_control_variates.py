"""Control variates: unbiased, silent at the mode, quadratic in the distance from it, and the law they give SGLD."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, JerkPoints, SamplerSettings, SubsampledDensity, find_mode
from avtorch.inference.sampler import walk
from benchmarks.bias.control_variates import ControlVariates
from tests.bars import BAR

F64 = torch.float64


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def gradient(function, z: Tensor) -> Tensor:
    z = z.detach().requires_grad_()
    return torch.autograd.grad(function(z).sum(), z)[0]


def by_point(density: SubsampledDensity, z: Tensor) -> Tensor:
    """Gradients from each point alone, ``(point, window, parameter)``."""
    each = torch.arange(density.points)[:, None]
    return torch.stack([gradient(lambda z, i=i: density.log_prob_minibatch(z, i), z) for i in each])


@pytest.fixture
def pair(make_windows):
    """Twelve points of three windows: as they are, and with control variates."""
    w = make_windows(3, [0.3, 1.0, 3.0], rows=120)
    density = JerkPoints(w.a[:, ::10], w.u[:, ::10], w.jerk[:, ::10])
    mode = find_mode(density)
    return density, ControlVariates(density, mode), mode


def test_the_estimate_is_the_definition(pair):
    """est(z) - [grad est(mode) - grad full(mode)] . (z - mode), for chains in leading dimensions.

    The bracket's mean over batches is zero, so the gradient is unbiased as that of `JerkPoints` is.
    """
    density, steady, mode = pair
    index = torch.tensor([3, 7, 7])
    at_mode = gradient(lambda z: density.log_prob_minibatch(z, index), mode.z) - gradient(density.log_prob, mode.z)
    z = mode.z + 0.1 * torch.randn(4, 2, 3, 3, generator=generator(0), dtype=F64)
    expected = density.log_prob_minibatch(z, index) - (at_mode * (z - mode.z)).sum(-1)
    assert isinstance(steady, SubsampledDensity)
    torch.testing.assert_close(steady.log_prob_minibatch(z, index), expected, rtol=1e-11, atol=1e-9)


def test_no_noise_at_the_mode_and_a_quadratic_growth_from_it(pair):
    density, steady, mode = pair
    plain = by_point(density, mode.z).var(0)
    assert (by_point(steady, mode.z).var(0) < 1e-20 * plain).all()
    direction = mode.scale.sum(-1)
    variances = [by_point(steady, mode.z + t * direction).var(0) for t in (1e-3, 5e-4)]
    order = (variances[0] / variances[1]).log2()
    # the next order adds a part of some t
    assert (order - 2).abs().max() < 0.02
    # one SD away much of the minibatch noise of a well excited window is still gone
    assert (by_point(steady, mode.z + mode.scale[..., 0]).var(0) < 0.5 * plain)[2].all()


def test_all_else_is_the_densitys_own(pair):
    density, steady, mode = pair
    assert (steady.names, steady.windows, steady.points) == (density.names, density.windows, density.points)
    assert steady.log_prob(mode.z).equal(density.log_prob(mode.z))
    assert steady.initial().equal(density.initial())
    some = torch.tensor([2, 0])
    z, index = mode.z + 0.1, torch.tensor([1, 5])
    chosen = steady.select(some)
    assert chosen.windows == 2
    assert chosen.constrain(z).equal(z.exp())
    torch.testing.assert_close(
        chosen.log_prob_minibatch(z[some], index), steady.log_prob_minibatch(z, index)[some], rtol=1e-13, atol=0
    )


class Line:
    """``y_i ~ N(z x_i, 1)``, one flat-prior parameter: ``x`` of shape ``(point,)``, ``y = x + noise``."""

    names = ("slope",)
    windows = 1

    def __init__(self, x: Tensor, y: Tensor) -> None:
        self.x, self.y = x, y
        self.seen: list[Tensor] = []

    @property
    def points(self) -> int:
        return len(self.x)

    @staticmethod
    def constrain(z: Tensor) -> Tensor:
        return z

    def select(self, index: Tensor) -> Line:
        return self

    def log_prob(self, z: Tensor) -> Tensor:
        return -0.5 * (self.y - z * self.x).square().sum(-1)

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        return -0.5 * self.points / len(index) * (self.y[index] - z * self.x[index]).square().sum(-1)

    def initial(self) -> Tensor:
        return torch.zeros(1, 1, dtype=F64)


class Recorded(ControlVariates):
    """Keeps the batches it was asked for."""

    def log_prob_minibatch(self, z: Tensor, index: Tensor) -> Tensor:
        self.density.seen.append(index)  # type: ignore[attr-defined]
        return super().log_prob_minibatch(z, index)


@pytest.mark.statistical
def test_the_law_of_sgld_with_control_variates(rotating_seed, draws_factor):
    """On a line the noise left multiplies the distance: ``w' = (1 - h R/2) w + sqrt(h) xi``, R the batch's precision.

    All chains share a batch, so the variance over chains follows ``M' = (1 - h R/2)^2 M + h`` exactly, batch by batch;
    its mean is ``1 / (1 - h/4 (1 + v))`` with ``v`` the variance of R. Without control variates it is above twice that.
    """
    g, chains, points, batch, h = generator(rotating_seed), 20_000 * draws_factor, 200, 20, 0.4
    x = 1 + 0.5 * torch.rand(points, generator=g, dtype=F64)
    y = x + torch.randn(points, generator=g, dtype=F64)
    line = Line(x, y)
    mode = find_mode(line)
    settings = SamplerSettings(
        chains=chains, draws=30, burn_in=0, thinning=5, step=h, noise="independent", batch=batch, spread=0.0
    )
    steady = Recorded(line, mode)
    line.seen.clear()
    z = walk(steady, mode, settings, generator=g)
    w = ((z - mode.z) / mode.scale[0])[..., 0, 0]
    share = points * x.square() / x.square().sum()
    assert len(line.seen) == 150
    variance, expected = 0.0, []
    for index in line.seen:
        variance = (1 - h / 2 * share[index].mean().item()) ** 2 * variance + h
        expected.append(variance)
    for k in (0, 4, 29):
        error = math.sqrt(2 / chains) * expected[5 * k + 4]
        assert abs(w[:, k].square().mean().item() - expected[5 * k + 4]) < BAR * error
    v = share.var(correction=0).item() / batch
    stationary = 1 / (1 - h / 4 * (1 + v))
    # the batches differ by so little that M wanders within a few per cent of its mean
    assert expected[-1] == pytest.approx(stationary, rel=0.2)
    residual = y - mode.z[0, 0] * x
    s2 = points**2 / batch * (residual * x).var(correction=0) / x.square().sum()
    assert (1 + h * s2 / 4) / (1 - h / 4) > 1.5 * stationary


def test_bad_input_is_refused_by_name(pair):
    density, _, mode = pair
    with pytest.raises(InputError, match=r"^density: JerkDensity has no minibatch"):
        ControlVariates(JerkDensity(density.statistics), mode)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"^mode: shape \(3, 3\)"):
        ControlVariates(JerkPoints(*(torch.ones(2, 9, dtype=F64) for _ in range(3))), mode)
