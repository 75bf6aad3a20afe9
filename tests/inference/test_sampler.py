"""Algorithm 1 against quadrature, its discretisation bias, overdispersed starts, schedules, minibatches, divergence."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import (
    ExcitationRule,
    JerkDensity,
    JerkPoints,
    SamplerSettings,
    find_mode,
    sample,
)
from avtorch.inference.coordinates import Coordinates, stiffness
from avtorch.inference.priors import Joint, QuadrantNormal, default_jerk_noise_prior
from avtorch.inference.sampler import walk
from avtorch.inference.sgld import harmonic, polynomial
from tests.bars import BAR

F64 = torch.float64
AMPLITUDES = [0.03, 0.1, 0.2, 0.4, 1.0, 3.0]
LAGS, GAINS = [0.3, 0.3, 1.5, 0.3, 1.5, 0.1], [1.0, 1.0, 0.5, 1.0, 0.5, 1.0]
CHAINS = 128


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def quadrature(density, mode, half: float = 7.0, nodes: int = 49) -> tuple[Tensor, Tensor]:
    """Posterior mean and SD of the parameters, ``(window, 3)``, by the trapezoid rule in whitened coordinates."""
    x = torch.linspace(-half, half, nodes, dtype=F64)
    grid = torch.cartesian_prod(x, x, x)[:, None, :].expand(-1, density.windows, -1)
    z = mode.z + torch.einsum("wij,cwj->cwi", mode.scale, grid)
    log_prob = density.log_prob(z)
    weight = (log_prob - log_prob.amax(0)).exp()
    weight = (weight / weight.sum(0))[..., None]
    value = z.exp()
    mean = (weight * value).sum(0)
    return mean, (weight * (value - mean).square()).sum(0).sqrt()


def against(draws: Tensor, mean: Tensor, sd: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Mean difference in SDs and SD ratio less one, each with its standard error from the independent chains."""
    score = (draws - mean) / sd
    shift, square = score.mean(1), score.square().mean(1)
    root = math.sqrt(len(draws))
    return shift.mean(0), shift.std(0) / root, 0.5 * (square.mean(0) - 1), 0.5 * square.std(0) / root


@pytest.mark.statistical
@pytest.mark.parametrize("prior", ["first", "lambda"])
def test_posteriors_are_those_of_quadrature(prior, make_windows, rotating_seed, draws_factor):
    """From hardly to well excited: 5 sigma, and 1 % for the step's bias in excited windows, 4 % in the others."""
    w = make_windows(rotating_seed, AMPLITUDES, T=LAGS, K=GAINS)
    belief = Joint(QuadrantNormal(torch.tensor([[0.4, 0.9]] * 6, dtype=F64), 0.25), default_jerk_noise_prior())
    density = JerkDensity(w.statistics, belief if prior == "lambda" else None)
    mode = find_mode(density)
    mean, sd = quadrature(density, mode)
    chains = CHAINS * draws_factor
    settings = SamplerSettings(chains=chains, draws=150)
    posterior = sample(density, settings, generator=generator(rotating_seed), mode=mode)
    assert posterior.converged.all()
    assert posterior.draws.shape == (chains, 150, 6, 3)
    shift, shift_error, wide, wide_error = against(posterior.draws, mean, sd)
    excited = ExcitationRule()(w.statistics, 200)
    assert excited[-2:].all()
    assert not excited[0]
    bias = torch.where(excited, 0.01, 0.04)[:, None]
    assert (shift.abs() < BAR * shift_error + bias).all()
    assert (wide.abs() < BAR * wide_error + bias).all()
    # and the comparison is worth making
    assert shift_error[excited].max() < 0.03
    assert wide_error[excited].max() < 0.03


@pytest.mark.statistical
def test_overdispersed_starts_are_forgotten(make_windows, rotating_seed, draws_factor):
    w = make_windows(rotating_seed, AMPLITUDES[3:], T=LAGS[3:], K=GAINS[3:])
    density = JerkDensity(w.statistics)
    mode = find_mode(density)
    mean, sd = quadrature(density, mode)
    settings = SamplerSettings(chains=CHAINS * draws_factor, draws=100, spread=2.0)
    posterior = sample(density, settings, generator=generator(rotating_seed), mode=mode)
    assert posterior.converged.all()
    shift, shift_error, wide, wide_error = against(posterior.draws, mean, sd)
    assert (shift.abs() < BAR * shift_error + 0.01).all()
    assert (wide.abs() < BAR * wide_error + 0.01).all()


@pytest.mark.statistical
def test_spread_is_in_posterior_sds(make_windows, rotating_seed, draws_factor):
    w = make_windows(rotating_seed, [0.1, 1.0])
    density = JerkDensity(w.statistics)
    mode = find_mode(density)
    settings = SamplerSettings(chains=4000 * draws_factor, draws=4, burn_in=0, step=1e-6, spread=2.0)
    z = walk(density, mode, settings, generator=generator(rotating_seed))[:, 0]
    ratio = z.var(0) / mode.covariance.diagonal(dim1=-2, dim2=-1)
    # four tiny steps add 1e-6; a variance from n draws is good to sqrt(2/n)
    assert (ratio / 4 - 1).abs().max() < BAR * math.sqrt(2 / len(z))


@pytest.mark.statistical
def test_minibatches_widen_as_they_should(make_windows, rotating_seed):
    """Batch 50 of 200 and step 0.2: a whitened gradient variance N/n = 4 on top, so Var = (1 + h)/(1 - h/4)."""
    w = make_windows(rotating_seed, [3.0])
    density = JerkPoints(w.a, w.u, w.jerk)
    mode = find_mode(density)
    settings = SamplerSettings(chains=256, draws=300, burn_in=60, step=0.2, noise="independent", batch=50)
    z = walk(density, mode, settings, generator=generator(rotating_seed))
    step = 0.2 / stiffness(density, Coordinates.of(mode)).item()
    # all chains share a batch, so they are not independent: the bar is that of 300 correlated steps of a common part
    _, _, wide, _ = against(z, z.mean((0, 1)), mode.covariance.diagonal(dim1=-2, dim2=-1).sqrt())
    expected = 0.5 * ((1 + step) / (1 - step / 4) - 1)
    assert expected > 0.04
    assert wide.mean().item() == pytest.approx(expected, abs=0.12)
    with pytest.raises(InputError, match=r"^batch: JerkDensity"):
        sample(JerkDensity(w.statistics), SamplerSettings(batch=10))


@pytest.mark.statistical
def test_the_papers_schedule_freezes(make_windows, rotating_seed):
    """eta_1/k leaves the chains near the mode where they started; (1 + k/100)^(-1/3) lets them reach the posterior."""
    w = make_windows(rotating_seed, [1.0])
    density = JerkDensity(w.statistics)
    mode = find_mode(density)
    sd = mode.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    ratio = {}
    for schedule in (harmonic, polynomial):
        settings = SamplerSettings(chains=64, draws=400, step=0.5, schedule=schedule)
        z = walk(density, mode, settings, generator=generator(rotating_seed))
        # within a chain, over its later half
        ratio[schedule] = (z[:, 200:].std(1).mean(0) / sd).mean().item()
    assert ratio[harmonic] < 0.3
    assert 0.8 < ratio[polynomial] < 1.1


def test_runs_repeat_and_thinning_takes_every_other_step(make_windows):
    density = JerkDensity(make_windows(0, [1.0, 0.3]).statistics)
    mode = find_mode(density)
    every = walk(density, mode, SamplerSettings(chains=8, draws=20, burn_in=4, thinning=1), generator=generator(1))
    again = walk(density, mode, SamplerSettings(chains=8, draws=20, burn_in=4, thinning=1), generator=generator(1))
    second = walk(density, mode, SamplerSettings(chains=8, draws=10, burn_in=4, thinning=2), generator=generator(1))
    assert every.equal(again)
    assert second.equal(every[:, 1::2])


@pytest.mark.statistical
def test_windows_keep_their_places_when_walked_at_several_paces(make_windows, rotating_seed):
    """Skewed windows before and between others, in every order: each ends where it ends alone, far from the rest."""
    w = make_windows(rotating_seed, [0.03, 3.0, 0.1, 3.0], T=[0.3, 0.1, 1.5, 1.0], K=[1.0, 1.0, 0.5, 0.6])
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        density = JerkDensity(w.statistics.select(torch.tensor(order)))
        mode = find_mode(density)
        # few chains, so that all four walk as one batch
        posterior = sample(density, SamplerSettings(chains=64), generator=generator(rotating_seed), mode=mode)
        z = posterior.draws.log()
        away = (z.mean((0, 1)) - mode.z).abs() / z.std((0, 1))
        # a skewed posterior's mean lies about one SD off its mode; a window in another's place would lie many
        assert away.max() < 3


class Valley:
    """``U = z^2/2`` in each of two windows, steeper by ``walls`` beyond 3.2, or not a number there."""

    names = ("x",)
    windows = 2

    def __init__(self, walls: tuple[float, float]) -> None:
        self.walls = torch.tensor(walls, dtype=F64)

    def log_prob(self, z: Tensor) -> Tensor:
        x = z[..., 0]
        beyond = (x.abs() - 3.2).clamp_min(0.0)
        return -0.5 * x.square() - torch.where(beyond > 0, self.walls, 0.0) * beyond.square()

    def initial(self) -> Tensor:
        return torch.zeros(2, 1, dtype=F64)


@pytest.mark.statistical
def test_a_step_that_is_too_long_is_halved_for_the_window_that_needs_it(rotating_seed):
    """Curvature 17 behind the wall, reached by some twenty draws: steps above 4/17 diverge there, 1.5/8 does not."""
    density = Valley((0.0, 8.0))
    settings = SamplerSettings(chains=2048)
    once = sample(density, replace(settings, attempts=1), generator=generator(rotating_seed))
    assert once.converged.tolist() == [True, False]
    posterior = sample(density, settings, generator=generator(rotating_seed))
    assert posterior.converged.all()
    assert posterior.draws.isfinite().all()
    # the settled window keeps its first draws
    assert posterior.draws[:, :, 0].equal(once.draws[:, :, 0])


@pytest.mark.statistical
@pytest.mark.parametrize("whitening", ["none", "diagonal"])
def test_a_walk_too_short_for_a_space_left_unwhitened_is_said(whitening, make_windows, rotating_seed):
    """Chains that begin at the mode agree with each other long before they have reached the posterior's width."""
    density = JerkDensity(make_windows(rotating_seed, [0.3, 1.0, 2.0]).statistics)
    exact = quadrature(density, find_mode(density))[1]
    short = SamplerSettings(whitening=whitening, attempts=1)
    found = sample(density, short, generator=torch.Generator().manual_seed(rotating_seed))
    ratio = found.sd / exact
    assert (float(ratio.min()) < 0.8) == (whitening == "none")  # one scale a parameter is enough here
    assert bool(found.converged.any()) == (whitening == "diagonal")
    for w in range(density.windows):
        assert not bool(found.converged[w]) or float(ratio[w].min()) > 0.9
        assert bool(found.converged[w]) or found.why[w]
    # as many steps as the widest direction takes are enough, and are taken for enough
    mode = find_mode(density)
    widest = Coordinates.of(mode, whitening).widest(mode)
    assert float(widest.min()) > 1.0
    torch.testing.assert_close(Coordinates.of(mode).widest(mode), torch.ones(3, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize("wall", [1e4, math.nan, math.inf, -3.0])
def test_divergence_is_said(wall, rotating_seed):
    """Far too steep, undefined, a cliff, or falling to minus infinity: not converged, and the neighbour is."""
    # long enough for some chain to meet the wall: 1e5 steps, of which about 1 in 700 would lie behind it
    settings = SamplerSettings(chains=1024, draws=100, thinning=1)
    posterior = sample(Valley((0.0, wall)), settings, generator=generator(rotating_seed))
    assert posterior.converged.tolist() == [True, False]
    assert posterior.draws[:, :, 0].isfinite().all()


@pytest.mark.parametrize(
    "options",
    [
        {"chains": 0},
        {"draws": 3},
        {"burn_in": -1},
        {"thinning": 0},
        {"attempts": 0},
        {"longest": 0.5},
        {"step": 0.0},
        {"step": 4.0},
        {"step": math.nan},
        {"spread": -1.0},
        {"batch": 0},
    ],
)
def test_bad_settings_are_refused_by_name(options):
    with pytest.raises(InputError, match=rf"^{next(iter(options))}: "):
        SamplerSettings(**options)
