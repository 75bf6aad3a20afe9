"""The law of SGLD: its noise, its stationary law and the order of its bias, against closed forms and exact kernels.

Many independent chains run side by side, so that standard errors are those of independent draws. Every bar is `BAR`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from torch import Tensor

from avtorch.inference import SGLD
from tests.bars import BAR

F64 = torch.float64


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def z_scores_of_moments(x: Tensor, y: Tensor, cov_xx: Tensor, cov_xy: Tensor) -> Tensor:
    """Deviations, in standard errors, of the means, covariances and cross covariances of Gaussian draws ``(chain, d)``.

    Means are known to be zero; the product of two Gaussians has variance ``S_ii S_jj + S_ij^2``.
    """
    chains = len(x)
    variances = cov_xx.diagonal()
    spread = torch.outer(variances, variances)
    mean = x.mean(0) / (variances / chains).sqrt()
    auto = (x.mT @ x / chains - cov_xx) / ((spread + cov_xx.square()) / chains).sqrt()
    cross = (y.mT @ x / chains - cov_xy) / ((spread + cov_xy.square()) / chains).sqrt()
    return torch.cat([mean, auto.flatten(), cross.flatten()])


@pytest.mark.statistical
@pytest.mark.parametrize(("h", "temperature"), [(0.05, 1.0), (0.4, 1.0), (1.2, 1.0), (0.4, 0.25)])
@pytest.mark.parametrize("noise", ["independent", "averaged"])
def test_a_chain_at_its_stationary_law_keeps_it(h, temperature, noise, rotating_seed, draws_factor):
    """Mean, covariance and lag-1 covariance of a correlated Gaussian, after 1, 2 and 10 steps.

    noise keeps P^-1 itself: y = x - sqrt(h) xi/2 is autoregressive with covariance P^-1 (I - hP/4), and cov(x', x) too.
    noise keeps P^-1 itself: y = x - sqrt(h) xi/2 is autoregressive, of cov P^-1 (I - hP/4) like cov(x', x).
    """
    g, chains, eye = generator(rotating_seed), 50_000 * draws_factor, torch.eye(2, dtype=F64)
    precision = torch.tensor([[2.0, -0.9], [-0.9, 1.0]], dtype=F64)
    shrink = eye - h * precision / 4
    inverse = torch.linalg.inv(precision)
    if noise == "independent":
        cov = inverse @ torch.linalg.inv(shrink)
        lagged = (eye - h * precision / 2) @ cov
        state = {}
    else:
        cov, lagged = inverse, inverse @ shrink
        state = {"noise": torch.randn(chains, 2, generator=g, dtype=F64)}
    start = torch.linalg.cholesky(lagged if state else cov)
    x = math.sqrt(temperature) * torch.randn(chains, 2, generator=g, dtype=F64) @ start.mT
    if state:
        x = x + 0.5 * math.sqrt(h * temperature) * state["noise"]
    x.requires_grad_()
    optimizer = SGLD([x], h, noise=noise, temperature=temperature, generator=g)
    if state:
        optimizer.state[x].update(state)
    for k in range(1, 11):
        before = x.detach().clone()
        optimizer.step(lambda: 0.5 * ((x @ precision) * x).sum(-1))
        if k in (1, 2, 10):
            score = z_scores_of_moments(before, x.detach(), temperature * cov, temperature * lagged)
            assert score.abs().max() < BAR, f"after {k} steps"


CASES = [(h, lam, s) for h in (0.05, 0.2, 0.8) for lam in (0.5, 3.0) for s in (0.0, 2.0)]


@pytest.mark.statistical
def test_stationary_variance_with_gradient_noise(rotating_seed, draws_factor):
    """Var = (1 + h s^2/4) / (lambda (1 - h lambda/4)), one parameter group a case.

    The chains start at the target's variance 1/lambda; of that, (1 - h lambda/2)^2k is left after k steps. The bar must
    also detect the usual mistakes: noise sqrt(2h), and noise h in place of sqrt(h).
    """
    g, chains, steps = generator(rotating_seed), 100_000 * draws_factor, 20
    x = [(torch.randn(chains, generator=g, dtype=F64) / math.sqrt(lam)).requires_grad_() for _, lam, _ in CASES]
    optimizer = SGLD([{"params": [p], "lr": h} for p, (h, _, _) in zip(x, CASES, strict=True)], 1.0, generator=g)

    def potential() -> Tensor:
        total = torch.zeros(chains, dtype=F64)
        for p, (_, lam, s) in zip(x, CASES, strict=True):
            total = total + 0.5 * lam * p.square()
            if s:
                total = total + s * torch.randn(chains, generator=g, dtype=F64) * p
        return total

    for _ in range(steps):
        optimizer.step(potential)
    for p, (h, lam, s) in zip(x, CASES, strict=True):
        left = (1 - h * lam / 2) ** (2 * steps)

        def variance(amplitude: float, h=h, lam=lam, s=s, left=left) -> float:
            stationary = (amplitude + h * s**2 / 4) / (lam * (1 - h * lam / 4))
            return stationary + left * (1 / lam - stationary)

        bar = BAR * math.sqrt(2 / chains) * variance(1.0)
        assert abs(p.detach().square().mean().item() - variance(1.0)) < bar, (h, lam, s)
        assert abs(variance(2.0) - variance(1.0)) > 5 * bar, "the bar is too wide to tell"
        assert abs(variance(h) - variance(1.0)) > 2 * bar, "the bar is too wide to tell"


@pytest.mark.statistical
def test_minibatches_on_the_scale_of_the_whole_window(rotating_seed, draws_factor):
    """A Gaussian mean, N points, batches of n: the closed form with s^2 = N^2/n Var(data)/sigma^4, Var(data) = sigma^2.

    N/n is in the closure, the sum over the window is what U means; dividing by N would give a variance N times this.
    """
    g, chains, N, n, sigma, h = generator(rotating_seed), 20_000 * draws_factor, 200, 20, 2.0, 0.002
    data = torch.randn(N, generator=g, dtype=F64)
    data = 1.0 + sigma * (data - data.mean()) / data.std(correction=0)
    lam, s2 = N / sigma**2, N**2 / n / sigma**2
    variance = (1 + h * s2 / 4) / (lam * (1 - h * lam / 4))
    assert variance > 1.25 / lam, "the minibatch part is meant to matter here"
    x = (data.mean() + math.sqrt(variance) * torch.randn(chains, generator=g, dtype=F64)).requires_grad_()
    optimizer = SGLD([x], h, generator=g)

    def potential() -> Tensor:
        batch = data[torch.randint(N, (chains, n), generator=g)]
        return N / n * 0.5 * ((x[:, None] - batch) / sigma).square().sum(-1)

    for _ in range(60):
        optimizer.step(potential)
    deviation = (x.detach() - data.mean()).square()
    # the minibatch noise is a sum of n bounded terms, so the draws are Gaussian enough for their own error estimate
    assert abs(deviation.mean().item() - variance) < BAR * deviation.std().item() / math.sqrt(chains)
    assert BAR * deviation.std().item() / math.sqrt(chains) < 0.1 * variance


def stationary_moment(
    drift: Callable[[np.ndarray], np.ndarray], scale: Callable[[np.ndarray], np.ndarray], h: float
) -> float:
    """E[x^2] under the exact law of ``x' = x + h drift(x)/2 + sqrt(h scale(x)) xi``, from its kernel on a grid."""
    x = np.linspace(-8, 8, 601)
    sd = np.sqrt(h * scale(x))
    kernel = np.exp(-0.5 * ((x[None, :] - (x + 0.5 * h * drift(x))[:, None]) / sd[:, None]) ** 2)
    kernel /= kernel.sum(1, keepdims=True)
    # law kernel = law, with its sum in place of the one equation that follows from the others
    system, right = kernel.T - np.eye(len(x)), np.zeros(len(x))
    system[-1], right[-1] = 1.0, 1.0
    return float((np.linalg.solve(system, right) * x**2).sum())


def time_average(
    optimizer: SGLD, x: Tensor, potential: Callable[[], Tensor], steps: int, burn: int
) -> tuple[float, float]:
    """E[x^2] over chains and steps, and its standard error from the spread of the independent chains' own averages."""
    total = torch.zeros_like(x)
    for k in range(burn + steps):
        optimizer.step(potential)
        if k >= burn:
            total += x.detach().square()
    average = total / steps
    return average.mean().item(), average.std().item() / math.sqrt(len(x))


def wavy(x: Tensor) -> Tensor:
    """Anharmonic and skewed, with a gradient that grows no faster than a Gaussian's: every step below one is stable."""
    return 0.5 * x.square() + 0.5 * torch.sin(2 * x)


def wavy_drift(x: np.ndarray) -> np.ndarray:
    return -x - np.cos(2 * x)


def wavy_moment() -> float:
    moments = [quad(lambda x, p=p: x**p * math.exp(-0.5 * (x**2 + math.sin(2 * x))), -9, 9)[0] for p in (0, 2)]
    return moments[1] / moments[0]


@pytest.mark.statistical
def test_bias_is_of_order_one_in_the_step(rotating_seed, draws_factor):
    """On an anharmonic target the measured bias is the exact kernel's, and its order lies where theory puts it."""
    g, truth = generator(rotating_seed), wavy_moment()
    steps, biases, errors = (0.4, 0.2), [], []
    exact = [stationary_moment(wavy_drift, np.ones_like, h) - truth for h in (*steps, 0.1, 0.05)]
    for h, expected in zip(steps, exact, strict=False):
        x = torch.zeros(20_000 * draws_factor, dtype=F64, requires_grad=True)
        moment, error = time_average(SGLD([x], h, generator=g), x, lambda x=x: wavy(x), round(30 / h), round(10 / h))
        assert abs(moment - truth - expected) < BAR * error
        biases.append(moment - truth)
        errors.append(error)
    order = math.log2(biases[0] / biases[1])
    bar = BAR / math.log(2) * math.hypot(errors[0] / biases[0], errors[1] / biases[1])
    theory = [math.log2(a / b) for a, b in pairwise(exact)]
    assert abs(order - theory[0]) < bar < 0.5
    # towards one as the step shrinks
    assert abs(theory[2] - 1) < 0.1
    assert abs(theory[2] - 1) < abs(theory[0] - 1)


@pytest.mark.statistical
def test_averaged_noise_has_hardly_a_bias(rotating_seed, draws_factor):
    """Leimkuhler-Matthews at h = 0.4 on the anharmonic target: below a tenth of the plain scheme's bias, 0.13.

    (Its order, two, shows only at steps whose bias would take 10^7 independent draws to detect.)
    """
    g, truth, h = generator(rotating_seed), wavy_moment(), 0.4
    x = torch.zeros(20_000 * draws_factor, dtype=F64, requires_grad=True)
    optimizer = SGLD([x], h, noise="averaged", generator=g)
    moment, error = time_average(optimizer, x, lambda: wavy(x), 150, 30)
    plain = stationary_moment(wavy_drift, np.ones_like, h) - truth
    assert BAR * error < 0.1 * plain
    assert abs(moment - truth) < 0.1 * plain


@pytest.mark.slow
@pytest.mark.statistical
def test_preconditioned_law_needs_gamma(rotating_seed, draws_factor):
    """pSGLD on a Gaussian, with alpha 0 (G a function of the place alone) and eps 1: the exact kernel's variance.

    Left out, Gamma would give the law exp(-U)/G, half as wide again.
    """
    g, h, eps = generator(rotating_seed), 0.2, 1.0
    x = torch.randn(40_000 * draws_factor, generator=g, dtype=F64).requires_grad_()
    optimizer = SGLD([x], h, preconditioner="rmsprop", alpha=0.0, eps=eps, chain_dims=1, generator=g)
    moment, error = time_average(optimizer, x, lambda: 0.5 * x.square(), 160, 80)

    def metric(x: np.ndarray) -> np.ndarray:
        return 1 / (eps + np.abs(x))

    with_gamma = stationary_moment(lambda x: -metric(x) * x - metric(x) ** 2 * np.sign(x), metric, h)
    without = stationary_moment(lambda x: -metric(x) * x, metric, h)
    assert abs(moment - with_gamma) < BAR * error
    # the target's variance is one; what is left is the step's bias, which falls with it
    assert abs(with_gamma - 1) < 0.15 < 0.4 < without - 1
    half = stationary_moment(lambda x: -metric(x) * x - metric(x) ** 2 * np.sign(x), metric, h / 4)
    assert abs(half - 1) < 0.5 * abs(with_gamma - 1)


@pytest.mark.parametrize("maximize", [False, True])
@pytest.mark.parametrize("eps", [1e-5, 0.7])
def test_gamma_is_the_derivative_of_the_preconditioner(maximize, eps, fresh_seed):
    """A noise-free-in-law step minus the step without Gamma is (h/2) dG/dtheta, by autograd of G written down here."""
    g, alpha, h = generator(fresh_seed), 0.9, 0.01
    start = torch.randn(4, 3, generator=g, dtype=F64)
    sign = -1.0 if maximize else 1.0

    def energy(x: Tensor) -> Tensor:
        # coupled within a chain, so that only the Hessian's diagonal is right
        return x.square().square().sum(-1) + x.prod(-1) + torch.sin(x).sum(-1)

    x = start.clone().requires_grad_()
    seed = 7
    optimizer = SGLD(
        [x],
        h,
        preconditioner="rmsprop",
        alpha=alpha,
        eps=eps,
        chain_dims=1,
        maximize=maximize,
        generator=generator(seed),
    )
    noise_source = generator(seed)
    mean_square = torch.autograd.grad(energy(x).sum(), x)[0].square()
    for _ in range(5):
        place = x.detach().clone().requires_grad_()
        (gradient,) = torch.autograd.grad(energy(place).sum(), place, create_graph=True)
        v = alpha * mean_square + (1 - alpha) * gradient.square()
        metric = 1 / (eps + v.sqrt())
        gamma = torch.zeros_like(place)
        for i in range(3):
            gamma[:, i] = torch.autograd.grad(metric[:, i].sum(), place, retain_graph=True)[0][:, i]
        noise = torch.randn(4, 3, generator=noise_source, dtype=F64)
        expected = place - h / 2 * (metric * gradient - gamma) + (h * metric).sqrt() * noise
        optimizer.step(lambda: sign * energy(x))
        # a few operations on numbers of order ten
        torch.testing.assert_close(x.detach(), expected.detach(), rtol=1e-12, atol=1e-12)
        mean_square = v.detach()


def test_gamma_of_a_linear_potential_is_zero():
    x = torch.zeros(2, dtype=F64, requires_grad=True)
    optimizer = SGLD([x], 0.1, temperature=0.0, preconditioner="rmsprop", eps=1.0)
    optimizer.step(lambda: 3 * x.sum())
    torch.testing.assert_close(x.detach(), torch.full((2,), -0.05 * 3 / 4, dtype=F64), rtol=1e-15, atol=0)
