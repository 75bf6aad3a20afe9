"""Priors: unit mass by quadrature, scores against autograd, draws against their laws, selection, bad arguments."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from avtorch.errors import InputError
from avtorch.inference.priors import (
    HalfNormalPrior,
    Joint,
    LogNormalPrior,
    LogSpaceNormal,
    Prior,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
)
from tests.bars import LEVEL

F64 = torch.float64

MEANS = torch.tensor([[0.3, 1.0], [1.5, 0.5], [0.02, 0.05], [-0.4, 0.2]], dtype=F64)
COV = torch.tensor([[[0.04, 0.018], [0.018, 0.01]], [[0.2, -0.1], [-0.1, 0.3]]], dtype=F64)


def triple() -> LogSpaceNormal:
    root = torch.tensor([[0.3, 0, 0], [0.2, 0.4, 0], [-0.1, 0.1, 0.2]], dtype=F64)
    return LogSpaceNormal(torch.tensor([[-1.0, 0.1, -2.0]], dtype=F64).repeat(2, 1), (root @ root.mT).repeat(2, 1, 1))


def pair(index: int) -> tuple[Prior, int]:
    """A prior over two parameters and its number of windows."""
    return [
        (default_actuation_prior(), 1),
        (HalfNormalPrior(torch.tensor([1.0, 0.2], dtype=F64)), 1),
        (QuadrantNormal(MEANS, 0.25), 4),
        (LogSpaceNormal(torch.tensor([[-1.0, 0.0], [0.5, -0.3]], dtype=F64), COV), 2),
    ][index]


def every_prior() -> dict[str, tuple[Prior, int, int]]:
    """Name to (prior, windows, parameters)."""
    named = {f"pair{i}": (*pair(i), 2) for i in range(4)}
    started = torch.tensor([True, False, True, False])
    first = Joint(default_actuation_prior(), default_jerk_noise_prior())
    later = Joint(QuadrantNormal(MEANS, 0.25), default_jerk_noise_prior())
    named |= {
        "noise": (default_jerk_noise_prior(), 1, 1),
        "first": (first, 1, 3),
        "later": (later, 4, 3),
        "triple": (triple(), 2, 3),
        "switch": (Switch(started, first, later), 4, 3),
        "switch-normal": (Switch(started[:2], first, triple()), 2, 3),
    }
    return named


@pytest.mark.parametrize("index", range(4))
def test_unit_mass_over_two_parameters(index):
    """The trapezoid rule in z over a range that leaves less than 1e-9 outside; smooth and vanishing at the ends."""
    prior, windows = pair(index)
    # towards zero the quadrant prior's and the half normal's densities fall like exp(z) only
    x = torch.linspace(-24, 6, 601, dtype=F64)
    grid = torch.cartesian_prod(x, x)[:, None, :].expand(-1, windows, -1)
    mass = prior.log_prob(grid).exp().sum(0) * (x[1] - x[0]) ** 2
    torch.testing.assert_close(mass, torch.ones_like(mass), rtol=0, atol=1e-8)


def test_unit_mass_of_noise_and_joint():
    x = torch.linspace(-25, 6, 3001, dtype=F64)
    mass = default_jerk_noise_prior().log_prob(x[:, None, None]).exp().sum(0) * (x[1] - x[0])
    assert mass.item() == pytest.approx(1.0, abs=1e-9)
    # a joint is the product of its blocks, so its mass is theirs
    z = torch.randn(5, 1, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    joint, _, _ = every_prior()["first"]
    parts = default_actuation_prior().log_prob(z[..., :2]) + default_jerk_noise_prior().log_prob(z[..., 2:])
    torch.testing.assert_close(joint.log_prob(z), parts)


def test_against_scipy():
    """Densities of the parameters themselves, times the Jacobian."""
    z = torch.randn(20, 1, 2, dtype=F64, generator=torch.Generator().manual_seed(0)) * 0.5
    value, jacobian = z.exp().numpy(), z.sum(-1).numpy()
    log_normal = stats.lognorm.logpdf(value, s=[0.7, 0.3], scale=[0.3, 1.0]).sum(-1) + jacobian
    np.testing.assert_allclose(default_actuation_prior().log_prob(z).numpy(), log_normal, rtol=1e-12)
    half = stats.halfnorm.logpdf(value[..., :1], scale=1.0).sum(-1) + z[..., 0].numpy()
    np.testing.assert_allclose(default_jerk_noise_prior().log_prob(z[..., :1]).numpy(), half, rtol=1e-12)
    for mean in MEANS:
        cut = stats.truncnorm(-mean.numpy() / 0.5, np.inf, loc=mean.numpy(), scale=0.5)
        quadrant = QuadrantNormal(mean[None], 0.25).log_prob(z).numpy()
        np.testing.assert_allclose(quadrant, cut.logpdf(value).sum(-1) + jacobian, rtol=1e-11)
    normal, _ = pair(3)
    for w in range(2):
        law = stats.multivariate_normal(normal.mean_z[w].numpy(), COV[w].numpy())
        found = normal.select(torch.tensor([w])).log_prob(z)[:, 0].numpy()
        np.testing.assert_allclose(found, law.logpdf(z[:, 0].numpy()), rtol=1e-12)


@pytest.mark.parametrize("name", every_prior())
def test_score_and_gradients(name):
    prior, windows, d = every_prior()[name]
    z = torch.randn(3, windows, d, dtype=F64, generator=torch.Generator().manual_seed(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(prior.log_prob(z).sum(), z)
    torch.testing.assert_close(prior.score(z.detach()), gradient, rtol=1e-12, atol=1e-12)
    assert gradcheck(prior.log_prob, [z], atol=1e-4, rtol=1e-4)
    assert gradgradcheck(prior.log_prob, [z], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", every_prior())
def test_finite_far_out(name):
    """T_L 0.02 to 5, K_L 0.05 to 3, sigma 1e-3 to 5: value and score are numbers."""
    prior, windows, d = every_prior()[name]
    ranges = torch.tensor([[0.02, 5.0], [0.05, 3.0], [1e-3, 5.0]], dtype=F64).log()[:d]
    corners = torch.cartesian_prod(*ranges) if d > 1 else ranges[0][:, None]
    z = corners.reshape(-1, 1, d).expand(-1, windows, d)
    assert prior.log_prob(z).isfinite().all()
    assert prior.score(z).isfinite().all()


def follows(draws: Tensor, law) -> None:
    assert stats.kstest(draws.numpy(), law.cdf).pvalue > LEVEL


@pytest.mark.statistical
def test_draws_follow_the_law(rotating_seed, draws_factor):
    g, n = torch.Generator().manual_seed(rotating_seed), 20_000 * draws_factor
    actuation = default_actuation_prior().sample(n, 2, generator=g)
    assert actuation.shape == (n, 2, 2)
    follows(actuation[:, 1, 0], stats.norm(math.log(0.3), 0.7))
    follows(actuation[:, 0, 1], stats.norm(0.0, 0.3))
    follows(default_jerk_noise_prior().sample(n, 1, generator=g)[:, 0, 0].exp(), stats.halfnorm(scale=1.0))
    quadrant = QuadrantNormal(MEANS, 0.25).sample(n, 4, generator=g).exp()
    for w, mean in enumerate(MEANS.tolist()):
        for i in range(2):
            follows(quadrant[:, w, i], stats.truncnorm(-mean[i] / 0.5, np.inf, loc=mean[i], scale=0.5))
    normal, _ = pair(3)
    z = normal.sample(n, 2, generator=g)
    for w in range(2):
        for direction in ([1.0, 0.0], [0.0, 1.0], [0.6, -0.8]):
            c = torch.tensor(direction, dtype=F64)
            centre, variance = float(normal.mean_z[w] @ c), float(c @ COV[w] @ c)
            follows(z[:, w] @ c, stats.norm(centre, math.sqrt(variance)))


@pytest.mark.statistical
def test_a_switch_takes_each_window_from_its_side(rotating_seed, draws_factor):
    switch, _, _ = every_prior()["switch"]
    assert isinstance(switch, Switch)
    z = torch.randn(6, 4, 3, dtype=F64, generator=torch.Generator().manual_seed(rotating_seed))
    later, first = switch.later.log_prob(z), switch.first.log_prob(z)
    assert switch.log_prob(z)[:, [0, 2]].equal(later[:, [0, 2]])
    assert switch.log_prob(z)[:, [1, 3]].equal(first[:, [1, 3]])
    draws = switch.sample(20_000 * draws_factor, 4, generator=torch.Generator().manual_seed(rotating_seed)).exp()
    follows(draws[:, 0, 0], stats.truncnorm(-0.3 / 0.5, np.inf, loc=0.3, scale=0.5))
    follows(draws[:, 1, 0].log(), stats.norm(math.log(0.3), 0.7))
    torch.testing.assert_close(switch.center()[0, :2], MEANS[0].log())
    torch.testing.assert_close(switch.center()[1, :2], torch.tensor([math.log(0.3), 0.0], dtype=F64))


@pytest.mark.parametrize("name", every_prior())
def test_selection_keeps_the_windows(name):
    prior, count, d = every_prior()[name]
    z = torch.randn(3, max(count, 4), d, dtype=F64, generator=torch.Generator().manual_seed(2))
    z = z[:, :count] if count > 1 else z
    for windows in ([0], [1, 0], [0, 2], [1, 3], [3, 0, 1]):
        if max(windows) < z.shape[1]:
            index = torch.tensor(windows)
            selected = prior.select(index).log_prob(z[:, index])
            torch.testing.assert_close(selected, prior.log_prob(z)[:, index], rtol=1e-13, atol=0)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: LogNormalPrior(torch.tensor([0.3, -1.0]), torch.tensor([0.7, 0.3])), "median"),
        (lambda: LogNormalPrior(torch.tensor([0.3, 1.0]), torch.tensor([0.0, 0.3])), "log_sd"),
        (lambda: LogNormalPrior(torch.tensor([0.3, math.nan]), torch.tensor([0.7, 0.3])), "median"),
        (lambda: HalfNormalPrior(torch.tensor([0.0])), "scale"),
        (lambda: QuadrantNormal(MEANS, 0.0), "variance"),
        (lambda: QuadrantNormal(MEANS, math.nan), "variance"),
    ],
)
def test_bad_arguments_are_named(build, name):
    with pytest.raises(InputError, match=f"^{name}"):
        build()
