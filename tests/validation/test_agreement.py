"""The measures of agreement against closed forms, and their Monte Carlo errors against what chance really does."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import Posterior, Quadrature, integrate
from avtorch.inference.priors import LogSpaceNormal

pytest.importorskip("arviz")

from avtorch.validation.agreement import agreement, between, sampling_diagnostics, superchains
from tests.bars import BAR

LOG_SD = 0.05


class LogNormals:
    """Two independent log-normal parameters, 2 and 3 in the median, as many windows as asked for."""

    names = ("first", "second")

    def __init__(self, windows: int) -> None:
        self.windows = windows
        self.center = torch.tensor([2.0, 3.0], dtype=torch.float64).log().expand(windows, 2)
        self.law = LogSpaceNormal(self.center, LOG_SD**2 * torch.eye(2, dtype=torch.float64).expand(windows, 2, 2))

    def log_prob(self, z: Tensor) -> Tensor:
        return self.law.log_prob(z)

    def initial(self) -> Tensor:
        return self.center

    def exact(self) -> Quadrature:
        """Windows are alike: one grid serves all."""
        one = integrate(LogNormals(1), nodes=33)
        repeat = {
            name: getattr(one, name).expand(self.windows, *getattr(one, name).shape[1:])
            for name in ("mean", "sd", "log_evidence", "error", "edge", "converged", "nodes", "mass")
        }
        return Quadrature(names=one.names, **repeat)

    def posterior(self, standard: Tensor) -> Posterior:
        """From standard normal draws ``(chain, draw, window, 2)``."""
        draws = (self.center + LOG_SD * standard).exp()
        return Posterior(self.names, draws, torch.ones(self.windows, dtype=torch.bool))


def even(count: int = 20_000, chains: int = 4) -> Posterior:
    """Draws of one window without any randomness but their order: the midpoint quantiles, shuffled."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    g = torch.Generator().manual_seed(0)
    columns = [torch.special.ndtri(share)[torch.randperm(count, generator=g)] for _ in range(2)]
    return LogNormals(1).posterior(torch.stack(columns, -1).reshape(chains, -1, 1, 2))


def autoregressive(shape: tuple[int, int, int, int], rho: float, seed: int) -> Tensor:
    """Stationary normal chains ``(chain, draw, window, parameter)``."""
    g = torch.Generator().manual_seed(seed)
    x = torch.randn(shape, generator=g, dtype=torch.float64)
    for k in range(1, shape[1]):
        x[:, k] = rho * x[:, k - 1] + math.sqrt(1 - rho**2) * x[:, k]
    return x


def test_exact_quantiles_agree_in_everything() -> None:
    found = agreement(even(), LogNormals(1).exact())
    assert found.mean_difference.abs().max() < 1e-4
    assert (found.sd_ratio - 1).abs().max() < 1e-3
    assert found.w1.max() < 1e-3
    assert bool(found.within().all())


def test_shift_is_the_mean_difference_and_the_w1_distance() -> None:
    exact = LogNormals(1).exact()
    draws = even()
    moved = Posterior(draws.names, draws.draws + 0.3 * exact.sd, draws.converged)
    found = agreement(moved, exact)
    assert found.mean_difference == pytest.approx(torch.full((1, 2), 0.3).numpy(), abs=1e-4)
    assert found.w1 == pytest.approx(torch.full((1, 2), 0.3).numpy(), abs=1e-3)
    assert (found.sd_ratio - 1).abs().max() < 1e-3
    assert not bool(found.within().any())
    assert found.z_mean.min() > 30


def test_inflation_is_the_sd_ratio_and_its_w1_that_of_the_mean_deviation() -> None:
    exact = LogNormals(1).exact()
    draws = even()
    wide = Posterior(draws.names, exact.mean + 1.1 * (draws.draws - exact.mean), draws.converged)
    found = agreement(wide, exact)
    assert (found.sd_ratio - 1.1).abs().max() < 1e-3
    deviation = (draws.flat - exact.mean).abs().mean(0) / exact.sd
    assert (found.w1 - 0.1 * deviation).abs().max() < 1e-3
    assert found.z_sd.min() > 5
    assert not bool(found.within().any())


def test_draws_beyond_the_grid_count_with_their_distance() -> None:
    exact = LogNormals(1).exact()
    draws = even()
    far = Posterior(draws.names, draws.draws + 1000 * exact.sd, draws.converged)
    assert agreement(far, exact).w1 == pytest.approx(torch.full((1, 2), 1000.0).numpy(), rel=1e-4)


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("chains", "draws", "rho"), [(4, 500, 0.0), (256, 10, 0.4), pytest.param(2, 1500, 0.7, marks=pytest.mark.slow)]
)
def test_z_scores_are_standard_and_the_expected_w1_is_met(
    chains: int, draws: int, rho: float, rotating_seed: int, draws_factor: int
) -> None:
    windows = 80 * draws_factor
    law = LogNormals(windows)
    found = agreement(law.posterior(autoregressive((chains, draws, windows, 2), rho, rotating_seed)), law.exact())
    # chi^2 of the z-scores within 5 sigma, and 6 % for the error of the effective sample size itself
    bar = BAR * math.sqrt(2 / (2 * windows)) + 0.12
    for z in (found.z_mean, found.z_sd):
        assert abs(float(z.square().mean()) - 1) < bar
    # W1 of one window scatters by about 40 %; far from the mean draws are less correlated than the mean's ESS counts
    ratio, bar = float((found.w1 / found.w1_expected).mean()), BAR * 0.4 / math.sqrt(2 * windows) + 0.04
    assert 1 - bar - 0.3 * rho < ratio < 1 + bar


@pytest.mark.slow
@pytest.mark.statistical
def test_chance_of_exact_draws_is_the_share_that_meets_the_tolerance(rotating_seed: int, draws_factor: int) -> None:
    windows = 150 * draws_factor
    law = LogNormals(windows)
    found = agreement(law.posterior(autoregressive((4, 150, windows, 2), 0.0, rotating_seed)), law.exact())
    chance = float(found.chance_within().mean())
    assert 0.5 < chance < 0.95
    assert abs(float(found.within().double().mean()) - chance) < BAR * math.sqrt(chance * (1 - chance) / windows) + 0.02
    assert float(found.chance_within(slack=2.0).mean()) > chance
    assert int(found.within(slack=2.0).sum()) >= int(found.within().sum())


@pytest.mark.statistical
def test_many_short_chains_are_not_counted_twice(rotating_seed: int) -> None:
    windows, chains, draws, rho = 20, 256, 20, 0.3
    law = LogNormals(windows)
    found = sampling_diagnostics(law.posterior(autoregressive((chains, draws, windows, 2), rho, rotating_seed)))
    lag = torch.arange(1, draws, dtype=torch.float64)
    exact = chains * draws / float(1 + 2 * ((1 - lag / draws) * rho**lag).sum())
    assert float(found.ess_mean.mean()) == pytest.approx(exact, rel=0.05)
    assert float(found.ess_bulk.mean()) == pytest.approx(exact, rel=0.05)
    assert float(found.rhat.max()) < 1.02


@pytest.mark.statistical
def test_chains_that_sit_still_count_one_draw_each(rotating_seed: int) -> None:
    still = autoregressive((256, 1, 10, 2), 0.0, rotating_seed).expand(-1, 20, -1, -1)
    assert float(sampling_diagnostics(LogNormals(10).posterior(still)).ess_mean.mean()) == pytest.approx(256, rel=0.15)


def test_superchains() -> None:
    draws = torch.arange(17 * 3).reshape(17, 3, 1, 1)
    joined = superchains(draws)
    assert joined.shape == (8, 6, 1, 1)
    assert joined[1].flatten().tolist() == list(range(6, 12))
    assert superchains(draws[:8]).shape == (8, 3, 1, 1)
    assert superchains(draws[:1].expand(1, 3, 1, 1)).shape == (2, 1, 1, 1)


@pytest.mark.slow
@pytest.mark.statistical
def test_two_sets_of_draws(rotating_seed: int, draws_factor: int) -> None:
    windows = 80 * draws_factor
    law = LogNormals(windows)
    first = law.posterior(autoregressive((64, 20, windows, 2), 0.3, rotating_seed))
    second = law.posterior(autoregressive((2, 700, windows, 2), 0.5, rotating_seed + 1))
    found = between(first, second)
    bar = BAR * math.sqrt(2 / (2 * windows)) + 0.12
    for z in (found.z_mean, found.z_sd):
        assert abs(float(z.square().mean()) - 1) < bar
    ratio, bar = float((found.w1 / found.w1_expected).mean()), BAR * 0.4 / math.sqrt(2 * windows) + 0.04
    assert 1 - bar - 0.15 < ratio < 1 + bar


def test_w1_of_two_sets_is_exact() -> None:
    draws = even(2000)
    moved = Posterior(draws.names, draws.draws + 0.3 * draws.sd, draws.converged)
    assert between(moved, draws).w1 == pytest.approx(torch.full((1, 2), 0.3, dtype=torch.float64).numpy(), rel=1e-9)
    assert float(between(draws, draws).w1.max()) < 1e-9
    # each draw twice is the same law
    twice = Posterior(draws.names, draws.draws.repeat(2, 1, 1, 1), draws.converged)
    assert float(between(draws, twice).w1.max()) < 1e-9


def test_what_cannot_be_compared() -> None:
    law = LogNormals(2)
    draws = law.posterior(autoregressive((4, 50, 2, 2), 0.0, 1))
    with pytest.raises(InputError, match=r"reference: has 1 windows, not 2"):
        agreement(draws, LogNormals(1).exact())
    with pytest.raises(InputError, match=r"reference: has the parameters"):
        between(draws, Posterior(("a", "b"), draws.draws, draws.converged))
    with pytest.raises(InputError, match=r"posterior: 2 draws a chain"):
        sampling_diagnostics(Posterior(draws.names, draws.draws[:, :2], draws.converged))


def test_arviz_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(InputError, match=r"needs pip install 'avtorch\[arviz\]' or 'avtorch\[validate\]'"):
        sampling_diagnostics(even(100))
