"""The Pyro model is the same density to round-off; NUTS over it agrees with quadrature."""

from __future__ import annotations

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("pyro")

from avtorch.errors import InputError
from avtorch.inference import JerkDensity, find_mode
from avtorch.inference.latent import LatentDensity, LatentWindow, default_noise_prior
from avtorch.inference.nuts import PositiveNormal, PyroModel, nuts
from avtorch.inference.priors import (
    HalfNormalPrior,
    Joint,
    LogNormalPrior,
    LogSpaceNormal,
    QuadrantNormal,
    Switch,
    default_jerk_noise_prior,
)
from avtorch.inference.quadrature import integrate
from benchmarks.peers.conjugate import sample_conjugate
from tests.bars import BAR

F64 = torch.float64


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


def priors(d: int, noise) -> dict:
    """Priors of two windows that differ between them wherever they can."""
    mean = torch.tensor([[0.4, 0.9], [0.05, 1.2]], dtype=F64)  # the second is cut by a good part
    root = 0.2 * torch.eye(d, dtype=F64) + 0.1 * torch.ones(d, d, dtype=F64).tril(-1)
    cov = torch.stack([root @ root.T, 2 * root @ root.T])
    belief = Joint(QuadrantNormal(mean, 0.25), noise)
    last = LogSpaceNormal(torch.linspace(-1, 1, 2 * d, dtype=F64).reshape(2, d), cov)
    pair = Joint(LogSpaceNormal(last.mean_z[:, :2], cov[:, :2, :2]), noise)
    return {
        "first": None,
        "log-normal": LogNormalPrior(0.1 + torch.rand(d, dtype=F64), 0.1 + torch.rand(d, dtype=F64)),
        "half-normal": HalfNormalPrior(0.1 + torch.rand(d, dtype=F64)),
        "lambda": belief,
        "posterior": last,
        "posterior of the pair": pair,
        "switch": Switch(torch.tensor([True, False]), belief, last),
    }


NAMES = list(priors(3, default_jerk_noise_prior()))


@pytest.mark.parametrize("rows", ["rows", "sums"])
@pytest.mark.parametrize("name", NAMES)
def test_jerk_model_is_the_density(name: str, rows: str, make_windows, fresh_seed: int) -> None:
    w = make_windows(fresh_seed, [0.3, 2.0])
    density = JerkDensity(w.statistics, priors(3, default_jerk_noise_prior())[name])
    g = torch.Generator().manual_seed(fresh_seed)
    points = density.initial() + torch.randn(10, 2, 3, generator=g, dtype=F64)
    expected = density.log_prob(points)
    for window in range(2):
        samples = (w.a[window], w.u[window], w.jerk[window]) if rows == "rows" else None
        model = PyroModel(density, window=window, samples=samples)
        found = torch.stack([model.log_prob(z) for z in points[:, window]])
        torch.testing.assert_close(found, expected[:, window], rtol=1e-10, atol=0)


@pytest.mark.parametrize("name", NAMES)
def test_latent_model_is_the_density(name: str, make_windows, fresh_seed: int) -> None:
    w = make_windows(fresh_seed, [0.5, 2.0], rows=60)
    data = LatentWindow(w.time.expand(2, -1).clone(), w.u, w.a, None, torch.ones_like(w.a, dtype=torch.bool))
    d = len(LatentDensity(data).names)
    noise = default_noise_prior(LatentDensity(data).names[2:])
    density = LatentDensity(data, priors(d, noise)[name])
    g = torch.Generator().manual_seed(fresh_seed)
    points = density.prior.center() + 0.5 * torch.randn(5, 2, d, generator=g, dtype=F64)
    expected = density.log_prob(points)
    for window in range(2):
        model = PyroModel(density, window=window)
        found = torch.stack([model.log_prob(z) for z in points[:, window]])
        torch.testing.assert_close(found, expected[:, window], rtol=1e-10, atol=0)


def test_another_density_is_seen(make_windows) -> None:
    """The equality above has teeth: rows of another window, or a prior a hundredth off, break it."""
    w = make_windows(1, [0.3, 2.0])
    density = JerkDensity(w.statistics)
    z = density.initial()
    wrong = PyroModel(density, window=0, samples=(w.a[1], w.u[1], w.jerk[1]))
    assert abs(wrong.log_prob(z[0]) - density.log_prob(z)[0]) > 1
    near = Joint(LogNormalPrior(f64(0.303, 1.0), f64(0.7, 0.3)), default_jerk_noise_prior())
    gone = PyroModel(JerkDensity(w.statistics, near)).log_prob(z[0]) - density.log_prob(z)[0]
    assert abs(gone) > 1e-8 * abs(density.log_prob(z)[0])


@pytest.mark.statistical
def test_positive_normal_draws_its_own_law(rotating_seed: int, draws_factor: int) -> None:
    law = PositiveNormal(f64(0.05), f64(0.5))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(rotating_seed)
        x = law.sample(torch.Size([20_000 * draws_factor]))[:, 0]
    grid = torch.linspace(0, 6, 20_001, dtype=F64)
    density = law.log_prob(grid).exp()
    assert float(torch.trapezoid(density, grid)) == pytest.approx(1, abs=1e-7)
    mean = float(torch.trapezoid(density * grid, grid))
    assert float(x.min()) > 0
    assert abs(float(x.mean()) - mean) < BAR * float(x.std()) / len(x) ** 0.5


def standard_error(x: Tensor, batches: int = 10) -> float:
    """Of the mean of a correlated series ``(draw,)``, from the larger of ArviZ's ESS-based one and batch means.

    Batch means detect slow drifts that an ESS of a few hundred draws may miss.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"\s*ArviZ is undergoing a major refactor", FutureWarning)
        arviz = pytest.importorskip("arviz")
    means = x[: len(x) // batches * batches].reshape(batches, -1).mean(1)
    own = np.ravel(arviz.mcse(x.numpy(), method="mean"))[0]  # an array of one number where numba is installed
    return max(float(own), float(means.std()) / batches**0.5)


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize("name", ["first", "lambda"])
def test_nuts_agrees_with_quadrature_and_conjugate(name: str, make_windows, rotating_seed: int) -> None:
    w = make_windows(rotating_seed, [0.2, 1.0])
    window = 0 if name == "lambda" else 1
    density = JerkDensity(w.statistics, priors(3, default_jerk_noise_prior())[name])
    exact = integrate(density, mode=find_mode(density))
    posterior = nuts(density, window=window, draws=300, warmup=200, seed=rotating_seed)
    assert posterior.draws.shape == (1, 300, 1, 3)
    # not `converged`: the halves of one chain of 300 draws differ by more than its R-hat allows about once in a hundred
    assert posterior.draws.isfinite().all()
    score = (posterior.draws[0, :, 0] - exact.mean[window]) / exact.sd[window]
    for i in range(3):
        assert abs(float(score[:, i].mean())) < BAR * standard_error(score[:, i])
        square = 0.5 * (score[:, i].square() - 1)
        assert abs(float(square.mean())) < BAR * standard_error(square)
        assert standard_error(score[:, i]) < 0.3  # the comparison is worth making
    other = sample_conjugate(density, generator=torch.Generator().manual_seed(rotating_seed))
    gap = (posterior.mean[0] - other.posterior.mean[window]).abs() / exact.sd[window]
    bar = [(standard_error(score[:, i]) ** 2 + float(2 / other.ess[window])) ** 0.5 for i in range(3)]
    assert (gap < BAR * f64(*bar)).all()


@pytest.mark.slow
def test_chains_repeat_by_seed_and_leave_the_global_state(make_windows) -> None:
    density = JerkDensity(make_windows(1, [1.0]).statistics)
    before = torch.get_rng_state()
    first, again, other = (nuts(density, chains=2, draws=8, warmup=8, seed=s) for s in (3, 3, 4))
    assert torch.equal(before, torch.get_rng_state())
    assert first.draws.shape == (2, 8, 1, 3)
    assert torch.equal(first.draws, again.draws)
    assert not torch.equal(first.draws, other.draws)
    assert not torch.equal(first.draws[0], first.draws[1])


def test_bad_input_names_itself(make_windows) -> None:
    w = make_windows(1, [1.0])
    density = JerkDensity(w.statistics)
    with pytest.raises(InputError, match="window: 1"):
        PyroModel(density, window=1)
    data = LatentWindow.single(w.time, w.u[0], accel=w.a[0])
    with pytest.raises(InputError, match="samples"):
        PyroModel(LatentDensity(data), samples=(w.a[0], w.u[0], w.jerk[0]))
    unknown = SimpleNamespace(select=lambda index: unknown, to=lambda device: unknown)
    with pytest.raises(InputError, match="prior: no Pyro"):
        PyroModel(JerkDensity(w.statistics, unknown))  # type: ignore[arg-type]
