"""The jerk density: values against exact rational arithmetic, gradients of both orders, sums, points, minibatches."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import combinations

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from avtorch.inference import JerkDensity, JerkPoints, JerkStatistics, jerk_log_likelihood
from avtorch.inference.density import Density, ScoredDensity, SubsampledDensity
from avtorch.inference.priors import (
    Joint,
    LogSpaceNormal,
    QuadrantNormal,
    Switch,
    default_actuation_prior,
    default_jerk_noise_prior,
)

F64 = torch.float64
EDGES = [(T, K, sigma) for T in (0.02, 0.3, 5.0) for K in (0.05, 1.0, 3.0) for sigma in (1e-3, 0.1, 5.0)]


def priors(windows: int, seed: int = 0) -> dict[str, object]:
    g = torch.Generator().manual_seed(seed)
    mean = 0.2 + torch.rand(windows, 2, generator=g, dtype=F64)
    root = torch.eye(3, dtype=F64) + 0.3 * torch.randn(windows, 3, 3, generator=g, dtype=F64)
    normal = LogSpaceNormal(torch.randn(windows, 3, generator=g, dtype=F64), root @ root.mT)
    first = Joint(default_actuation_prior(), default_jerk_noise_prior())
    quadrant = Joint(QuadrantNormal(mean, 0.25), default_jerk_noise_prior())
    started = torch.arange(windows) % 2 == 0
    return {
        "first": first,
        "lambda": quadrant,
        "posterior": normal,
        "switch": Switch(started, first, quadrant),
        "switch-posterior": Switch(started, first, normal),
    }


@pytest.mark.parametrize("check", [gradcheck, gradgradcheck])
@pytest.mark.parametrize("shape", [(), (2,), (3, 2)])
def test_likelihood_gradients(check, shape, fresh_seed):
    g = torch.Generator().manual_seed(fresh_seed)
    T, K, sigma = (0.3 + torch.rand(shape, generator=g, dtype=F64) for _ in range(3))
    a, u, jerk = (torch.randn(*shape, 4, generator=g, dtype=F64) for _ in range(3))
    assert check(jerk_log_likelihood, [x.requires_grad_() for x in (T, K, sigma, a, u, jerk)])


@pytest.mark.parametrize("check", [gradcheck, gradgradcheck])
@pytest.mark.parametrize("kind", ["first", "lambda", "posterior", "switch", "switch-posterior"])
def test_density_gradients(check, kind, make_windows, fresh_seed):
    w = make_windows(fresh_seed, [1.0, 0.5], rows=20, sigma=0.5)
    density = JerkDensity(w.statistics, priors(2, fresh_seed)[kind])
    z = torch.randn(3, 2, 3, generator=torch.Generator().manual_seed(fresh_seed), dtype=F64) * 0.3 - 0.3
    # central differences of a potential of some thousands: the default step is right, its relative bar too
    assert check(density.log_prob, [z.requires_grad_()], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("kind", ["first", "lambda", "posterior", "switch", "switch-posterior"])
def test_score_is_the_gradient(kind, make_windows, fresh_seed):
    w = make_windows(fresh_seed, [1.0, 0.5, 0.01])
    density = JerkDensity(w.statistics, priors(3, fresh_seed)[kind])
    z = torch.randn(5, 3, 3, generator=torch.Generator().manual_seed(fresh_seed), dtype=F64).requires_grad_()
    (gradient,) = torch.autograd.grad(density.log_prob(z).sum(), z)
    scale = gradient.abs().amax(-1, keepdim=True)
    assert ((density.score(z.detach()) - gradient) / (1 + scale)).abs().max() < 1e-12


def exact(T: float, K: float, sigma: float, rows: list[tuple[float, float, float]]) -> tuple[Fraction, list[Fraction]]:
    """Half chi2 and the gradient of the log likelihood in T, K, sigma, without rounding."""
    t, k, s = Fraction(T), Fraction(K), Fraction(sigma)
    chi2, slope = Fraction(0), [Fraction(0)] * 3
    for a, u, jerk in ((Fraction(x) for x in row) for row in rows):
        model = (k * u - a) / t
        r = jerk - model
        chi2 += r * r / s**2
        slope[0] += r / s**2 * (-model / t)
        slope[1] += r / s**2 * u / t
        slope[2] += r * r / s**3
    slope[2] -= len(rows) / s
    return chi2 / 2, slope


@pytest.mark.parametrize(("T", "K", "sigma"), EDGES)
def test_edges_of_the_ranges(T, K, sigma, make_windows):
    """Value and gradient are finite and right to round-off where lag, gain and noise are extreme."""
    w = make_windows(5, [1.5], T=T, K=K, sigma=sigma, rows=12)
    rows = list(zip(w.a[0].tolist(), w.u[0].tolist(), w.jerk[0].tolist(), strict=True))
    half_chi2, slope = exact(T, K, sigma, rows)
    value = -float(half_chi2) - len(rows) * (math.log(sigma) + 0.5 * math.log(2 * math.pi))
    theta = [torch.tensor(x, dtype=F64, requires_grad=True) for x in (T, K, sigma)]
    found = jerk_log_likelihood(*theta, w.a[0], w.u[0], w.jerk[0])
    gradient = torch.autograd.grad(found, theta)
    # a residual is rounded by eps x the largest jerk; relative to sigma this may be amplified, in chi2 and its slopes
    largest = w.jerk.abs().max().item() + 1
    relative = 64 * torch.finfo(F64).eps * (1 + largest / sigma) * len(rows)
    assert found.item() == pytest.approx(value, rel=relative, abs=relative * (1 + abs(value)))
    for g, s, unit in zip(gradient, slope, (T, K, sigma), strict=True):
        bound = relative * (1 + largest / sigma) * len(rows) / unit * 10
        assert math.isfinite(g.item())
        assert abs(g.item() - float(s)) < bound

    density = JerkDensity(w.statistics)
    z = torch.tensor([[T, K, sigma]], dtype=F64).log()
    # the sums lose what the squares of the largest terms swallow
    swallowed = 64 * torch.finfo(F64).eps * len(rows) * (largest / sigma) ** 2
    assert abs(density.log_likelihood(z).item() - value) < relative * (1 + abs(value)) + swallowed
    assert density.score(z).isfinite().all()


def test_sums_and_points_agree(make_windows, fresh_seed):
    w = make_windows(fresh_seed, [1.0, 0.3, 0.03], T=[0.2, 0.5, 1.5], K=[1.0, 0.8, 0.5])
    z = torch.randn(7, 3, 3, generator=torch.Generator().manual_seed(fresh_seed), dtype=F64)
    T, K, sigma = z.exp().unbind(-1)
    points = jerk_log_likelihood(T, K, sigma, w.a, w.u, w.jerk)
    torch.testing.assert_close(JerkDensity(w.statistics).log_likelihood(z), points, rtol=1e-10, atol=1e-10)


def test_the_likelihood_is_a_normalised_density_of_the_jerk():
    """Integrated over the jerk of a one-point window it gives one."""
    jerk = torch.linspace(-40, 40, 4001, dtype=F64)[:, None]
    T, K, sigma = (torch.tensor(x, dtype=F64) for x in (0.5, 0.9, 1.3))
    a, u = torch.tensor([0.4], dtype=F64), torch.tensor([-1.0], dtype=F64)
    density = jerk_log_likelihood(T, K, sigma, a, u, jerk).exp()
    # the trapezoid rule is exact to round-off for a smooth density that vanishes at both ends
    assert torch.trapezoid(density, jerk[:, 0]).item() == pytest.approx(1.0, rel=1e-12)


def test_float32_is_kept(make_windows):
    w = make_windows(1, [1.0])
    theta = [torch.tensor([x], requires_grad=True) for x in (0.4, 0.9, 0.5)]
    rows = [x.float() for x in (w.a, w.u, w.jerk)]
    value = jerk_log_likelihood(*theta, *rows)
    assert value.dtype == torch.float32
    (slope,) = torch.autograd.grad(value.sum(), theta[0])
    assert slope.dtype == torch.float32
    wide = jerk_log_likelihood(*(x.double() for x in theta), *(x.double() for x in rows))
    assert value.item() == pytest.approx(wide.item(), rel=200 * torch.finfo(torch.float32).eps)


@pytest.mark.parametrize("size", [1, 2])
def test_minibatches_are_unbiased(size, make_windows, fresh_seed):
    """The estimate averaged over every batch of the size is the whole, prior counted once."""
    w = make_windows(fresh_seed, [1.0, 0.2], rows=9)
    density = JerkPoints(w.a, w.u, w.jerk)
    z = torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(fresh_seed), dtype=F64)
    batches = [torch.tensor(c) for c in combinations(range(9), size)]
    average = torch.stack([density.log_prob_minibatch(z, index) for index in batches]).mean(0)
    torch.testing.assert_close(average, density.log_prob(z), rtol=1e-11, atol=1e-9)


def test_the_protocols_are_met(make_windows):
    w = make_windows(1, [1.0])
    density = JerkPoints(w.a, w.u, w.jerk)
    assert isinstance(density, Density)
    assert isinstance(density, ScoredDensity)
    assert isinstance(density, SubsampledDensity)
    assert not isinstance(JerkDensity(w.statistics), SubsampledDensity)
    assert density.names == ("T_L", "K_L", "sigma")


def test_masked_rows_leave_no_trace(make_windows):
    w = make_windows(1, [1.0, 0.4])
    mask = torch.ones(2, 200, dtype=torch.bool)
    mask[0, 50:80] = False
    mask[1] = False
    u = torch.where(mask, w.u, torch.nan)
    masked = JerkStatistics.from_samples(w.a, u, w.jerk, mask)
    kept = JerkStatistics.from_samples(w.a[:1, mask[0]], w.u[:1, mask[0]], w.jerk[:1, mask[0]])
    assert masked.n.tolist() == [170.0, 0.0]
    for name in ("jj", "aj", "uj", "aa", "au", "uu"):
        assert getattr(masked, name)[0].item() == pytest.approx(getattr(kept, name)[0].item(), rel=1e-13)
        assert getattr(masked, name)[1] == 0
    # an empty window leaves the prior alone
    density = JerkDensity(masked)
    z = torch.randn(2, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    assert density.log_prob(z)[1] == density.prior.log_prob(z)[1]
    assert density.initial().isfinite().all()


def test_least_squares_and_the_start(make_windows):
    w = make_windows(3, [1.0, 0.0], T=[0.6, 0.6], K=[0.8, 0.8], sigma=1e-4)
    inverse_lag, gain_over_lag, sd = w.statistics.least_squares()
    assert 1 / inverse_lag[0].item() == pytest.approx(0.6, rel=1e-4)
    assert (gain_over_lag / inverse_lag)[0].item() == pytest.approx(0.8, rel=1e-4)
    # 198 degrees of freedom: 5 sigma of a chi is 5/sqrt(2 x 198)
    assert sd[0].item() == pytest.approx(1e-4, rel=5 / math.sqrt(2 * 198))
    assert inverse_lag[1].isnan()
    start = JerkDensity(w.statistics).initial().exp()
    assert start[0, 0].item() == pytest.approx(0.6, rel=1e-4)
    torch.testing.assert_close(start[1, :2], torch.tensor([0.3, 1.0], dtype=F64))
