"""Weighted draws: their law, their refusal where weights mean nothing, and coverage on windows of the latent form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import integrate
from avtorch.inference.density import Density
from avtorch.inference.estimators import ImportanceSampling
from avtorch.inference.estimators.other_posteriors import FIRST
from avtorch.inference.importance import ImportanceSettings, WeightedDraws, weighted_draws
from avtorch.inference.latent import LatentDensity, LatentWindow, default_noise_prior
from avtorch.inference.map import Mode
from avtorch.inference.sequential import Solved
from avtorch.validation import synthetic_windows
from tests.bars import BAR
from tests.inference.latent_windows import drawn_window


@dataclass(frozen=True)
class Student:
    """Student's t in ``d`` dimensions, centred, of unit scale."""

    degrees: float
    d: int = 5
    windows: int = 1

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"x{i}" for i in range(self.d))

    def log_prob(self, z: Tensor) -> Tensor:
        return -0.5 * (self.degrees + self.d) * torch.log1p(z.square().sum(-1) / self.degrees)

    def initial(self) -> Tensor:
        return torch.full((1, self.d), 0.1, dtype=torch.float64)


@pytest.mark.statistical
def test_moments_of_a_known_law(rotating_seed: int) -> None:
    draws = weighted_draws(Student(30.0), generator=torch.Generator().manual_seed(rotating_seed))
    mean, covariance = draws.moments()
    variance = 30.0 / 28.0
    error = (variance / float(draws.effective[0])) ** 0.5
    assert float(mean.abs().max()) < BAR * error
    # the fourth moment of this t is 3.23 variances squared, so that a square's SD is 1.5 times its mean
    assert float((covariance[0].diagonal() / variance - 1).abs().max()) < BAR * 1.5 / float(draws.effective[0]) ** 0.5
    low, high = draws.quantile(0.05), draws.quantile(0.95)
    # 1.697: the 95 % quantile of this t; an empirical quantile's SD is that of the share over the density there
    bar = BAR * (0.05 * 0.95 / float(draws.effective[0])) ** 0.5 / 0.098
    assert float((low + 1.697).abs().max()) < bar
    assert float((high - 1.697).abs().max()) < bar


@pytest.mark.slow
@pytest.mark.statistical
def test_agreement_with_quadrature(rotating_seed: int) -> None:
    density = synthetic_windows(6, seed=rotating_seed).density
    draws = weighted_draws(density, generator=torch.Generator().manual_seed(rotating_seed))
    exact = integrate(density)
    where = draws.converged(ImportanceSettings()) & exact.converged
    mean = (draws.weight[..., None] * draws.z.exp()).sum(0)
    off = (mean - exact.mean).abs() / exact.sd
    assert bool((off[where] < BAR / draws.effective[where, None].sqrt()).all())
    # a window without excitation may have weights that are not reliable, and is then not claimed
    assert bool(where.any())


def test_the_same_seed_gives_the_same_draws(fresh_seed: int) -> None:
    density, _ = drawn_window(torch.Generator().manual_seed(fresh_seed), accel=True, speed=True, rows=50, dt=0.02)
    one, again, other = (weighted_draws(density, generator=torch.Generator().manual_seed(s)) for s in (3, 3, 4))
    assert bool((one.z == again.z).all() & (one.weight == again.weight).all())
    assert one.z.shape != other.z.shape or not bool((one.z == other.z).all())


def test_heavy_weights_are_not_claimed() -> None:
    shape, effective = torch.tensor([0.6, 0.8, 0.5, 0.65]), torch.tensor([400.0, 400.0, 150.0, 400.0])
    # a shape of 0.65 needs a thousand draws or more
    for count, claimed in ((512, [True, False, False, False]), (4096, [True, False, False, True])):
        z, weight = (
            torch.zeros(count, 4, 2, dtype=torch.float64),
            torch.full((count, 4), 1 / count, dtype=torch.float64),
        )
        found = WeightedDraws(z, weight, shape, effective).converged(ImportanceSettings())
        assert found.tolist() == claimed


@pytest.mark.parametrize("change", [{"draws": 255}, {"draws": 10}, {"rounds": 0}, {"enough": 0.0}, {"width": -1.0}])
def test_settings_out_of_range_are_refused_by_name(change: dict[str, float]) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(change))}: "):
        ImportanceSettings(**change)  # type: ignore[arg-type]


@pytest.mark.statistical
def test_few_draws_have_the_law_of_many_where_a_clock_jitters(rotating_seed: int) -> None:
    """On a window whose draws are reliable; of some they are not, and the answer does not use them."""
    generator = torch.Generator().manual_seed(rotating_seed)
    for _ in range(20):
        density, _ = drawn_window(generator, accel=True, speed=True, rows=100, dt=0.02, jitter=0.3)
        quick = weighted_draws(density, generator=generator)
        if bool(quick.converged(ImportanceSettings())[0]):
            break
    else:
        pytest.fail("no window of twenty has reliable draws")
    long = weighted_draws(density, ImportanceSettings(draws=1024, enough=2000.0), generator=generator)
    # of lag and gain; along a ridge between two noises one window of 75 misses a part (benchmarks/estimators.md)
    # shares below the medians: a tail may be so heavy that a mean has no error by the number of draws
    middle = torch.stack(
        [_median(z, weight) for z, weight in zip(long.z[:, 0, :2].T, long.weight.T.expand(2, -1), strict=True)]
    )
    (share, error), (half, own) = (_below(draws, middle) for draws in (quick, long))
    assert bool(((share - half).abs() < BAR * (error**2 + own**2).sqrt()).all())


def _median(z: Tensor, weight: Tensor) -> Tensor:
    order = z.argsort()
    return z[order][int((weight[order].cumsum(0) < 0.5).sum())]


def _below(draws: WeightedDraws, bound: Tensor) -> tuple[Tensor, Tensor]:
    """Share (parameter,) of the one window's draws below `bound`, of the first parameters, and its standard error."""
    below, weight = (draws.z[:, 0, : len(bound)] < bound).double(), draws.weight[:, :1]
    share = (weight * below).sum(0)
    return share, (weight**2 * (below - share) ** 2).sum(0).sqrt()


class Drawn(ImportanceSampling):
    """Without SGLD behind it, which takes minutes where rows are uneven: windows that it would sample are not used."""

    def _chains(self, density: Density, mode: Mode) -> Solved:
        never = torch.zeros(density.windows, dtype=torch.bool)
        return self._drawn(density, mode, FIRST)._replace(converged=never)


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(("channels", "windows"), [("speed", 333), ("both", 333), ("jitter", 111)])
def test_intervals_hold_the_truth_as_often_as_they_say(channels: str, windows: int, rotating_seed: int) -> None:
    """90 % intervals on windows drawn from their own law, parameters from the prior: coverage of T_L and K_L."""
    generator = torch.Generator().manual_seed(rotating_seed)
    settings = {"accel": channels != "speed", "speed": True, "jitter": 0.3 if channels == "jitter" else 0.0}
    drawn = [drawn_window(generator, rows=100, dt=0.02, **settings) for _ in range(windows)]
    density = LatentDensity(LatentWindow.stack([each.data for each, _ in drawn]))
    truth = torch.stack([each[:2] for _, each in drawn])
    noise = default_noise_prior(density.names[2:])
    loop = Drawn(vehicles=windows, names=density.names, noise_prior=noise, seed=rotating_seed % 1000)
    belief = loop.update(lambda index, prior: density, torch.ones(windows, dtype=torch.bool))
    inside = ((belief.q05[:, :2] <= truth) & (truth <= belief.q95[:, :2])).double()[belief.converged]
    assert len(inside) > 0.9 * windows
    bar = BAR * math.sqrt(0.9 * 0.1 / len(inside))
    assert float((inside.mean(0) - 0.9).abs().max()) < bar, inside.mean(0).tolist()
