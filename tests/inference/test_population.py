"""Partial pooling: the margin is that of the model, and SGLD agrees with NUTS over Pyro's own statements."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference import PopulationMargin, sample
from avtorch.inference.population import MEAN_SD, SPREAD
from tests.bars import BAR

F64 = torch.float64
CAR = torch.tensor([0, 0, 0, 1, 1, 2, 2, 3, 4, 4, 5, 5])


def fleet(seed: int) -> tuple[Tensor, Tensor]:
    """Drives `(quantity, drive)` of six cars by the model itself, and their standard deviations."""
    g = torch.Generator().manual_seed(seed)
    cars = torch.tensor([[-1.0], [0.0]], dtype=F64) + 0.2 * torch.randn(2, 6, generator=g, dtype=F64)
    sd = 0.03 + 0.05 * torch.rand(2, len(CAR), generator=g, dtype=F64)
    noise = (sd**2 + 0.08**2).sqrt() * torch.randn(2, len(CAR), generator=g, dtype=F64)
    return cars[:, CAR] + noise, sd


def points(seed: int, d: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    centre = torch.tensor([-0.5, -1.7, -2.3] + [0.0] * (d - 3), dtype=F64)
    return centre + 0.5 * torch.randn(20, 2, d, generator=g, dtype=F64)


@pytest.mark.parametrize("once", [False, True])
def test_the_density_is_the_model_s(once: bool) -> None:
    """Drives of a car share its distance from the mean: by one normal of all drives, and the priors as they stand."""
    y, sd = fleet(3)
    car = torch.arange(6) if once else CAR
    y, sd = y[:, : len(car)], sd[:, : len(car)]
    density = PopulationMargin(y, sd, car)
    assert density.names == (("mean", "between") if once else ("mean", "between", "within"))
    z = points(4, 3)[0, :, : len(density.names)]
    mean, between, *rest = density.constrain(z).unbind(-1)
    within = rest[0] if rest else torch.zeros_like(mean)
    shared = (car[:, None] == car).double() * between[:, None, None] ** 2
    spread = shared + torch.diag_embed(sd**2 + within[:, None] ** 2)
    said = torch.distributions.MultivariateNormal(mean[:, None].expand_as(y), spread).log_prob(y)
    said = said + torch.distributions.Normal(torch.zeros((), dtype=F64), MEAN_SD).log_prob(mean)
    gamma = torch.distributions.Gamma(torch.full((), 2.0, dtype=F64), 2 / SPREAD)
    # the Jacobian of a logarithm is the spread itself
    said = said + sum(gamma.log_prob(x) + x.log() for x in (between, *rest))
    torch.testing.assert_close(density.log_prob(z), said, rtol=1e-10, atol=1e-9)


def test_a_car_with_little_data_is_drawn_to_its_siblings() -> None:
    y = torch.tensor([[-1.0, -1.02, -0.98, -1.01, 0.0, 0.0]], dtype=F64)
    sd = torch.tensor([[0.05, 0.05, 0.05, 0.05, 0.01, 1.0]], dtype=F64)
    margin = PopulationMargin(y, sd, torch.arange(6))
    mean, variance = margin.cars_given(torch.tensor([[-0.9, -1.2]], dtype=F64))
    assert abs(float(mean[0, 4])) < 0.01  # known well: it keeps its own
    assert float(mean[0, 5]) < -0.7  # known badly: the siblings'
    assert (variance.sqrt() < sd).all()
    # between -> 0: all cars are the mean, without a division by zero
    none, zero = margin.cars_given(torch.tensor([[-0.9, -800.0]], dtype=F64))
    assert (none == -0.9).all()
    assert (zero == 0).all()


@pytest.mark.statistical
@pytest.mark.slow
def test_sgld_agrees_with_nuts(rotating_seed: int) -> None:
    """NUTS walks the model as Pyro is told it, in coordinates that the density does not use."""
    pyro = pytest.importorskip("pyro")
    from pyro import distributions as dist
    from pyro.infer import MCMC, NUTS

    y, sd = fleet(rotating_seed)
    density = PopulationMargin(y[:1], sd[:1], CAR)
    walked = sample(density, generator=torch.Generator().manual_seed(rotating_seed))
    assert walked.draws.isfinite().all()

    def model() -> None:
        mean = pyro.sample("mean", dist.Normal(torch.zeros((), dtype=F64), MEAN_SD))
        spreads = pyro.sample("spreads", dist.Gamma(torch.full((2,), 2.0, dtype=F64), 2 / SPREAD).to_event(1))
        away = pyro.sample("away", dist.Normal(torch.zeros(6, dtype=F64), 1.0).to_event(1))
        theta = pyro.deterministic("cars", mean + spreads[0] * away)
        pyro.sample("y", dist.Normal(theta[CAR], (sd[0] ** 2 + spreads[1] ** 2).sqrt()).to_event(1), obs=y[0])

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(rotating_seed)
        run = MCMC(NUTS(model, target_accept_prob=0.9), 1500, 500, disable_progbar=True)
        run.run()
    found = run.get_samples()
    nuts = torch.cat([found["mean"][:, None], found["spreads"].sqrt()], -1)
    ours = walked.draws[:, :, 0].clone()
    # spreads have a long tail to the right, their logarithms one to the left, in which 1,500 draws settle no square
    ours[..., 1:3] = ours[..., 1:3].sqrt()
    centre, scale = nuts.mean(0), nuts.std(0)
    for power in (1, 2):
        theirs, mine = ((nuts - centre) / scale) ** power, ((ours - centre) / scale) ** power
        # NUTS: means of 15 batches of a hundred draws; SGLD: means of independent chains
        batches, chains = theirs.unflatten(0, (15, -1)).mean(1), mine.mean(1)
        error = (batches.var(0) / len(batches) + chains.var(0) / len(chains)).sqrt()
        assert (error < 0.15 * power).all(), "the comparison is worth making"
        # 0.03 SDs (0.06 of the squares) for the step of SGLD, about what `sample` itself lets pass
        assert ((theirs.mean(0) - mine.mean((0, 1))).abs() < BAR * error + 0.03 * power).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda y, sd, car: (y[0], sd[0], car), r"values, sd, car: found shapes \(12,\)"),
        (lambda y, sd, car: (y, sd[:, 1:], car), "found shapes"),
        (lambda y, sd, car: (y, 0 * sd, car), "need sd above 0"),
        (lambda y, sd, car: (y / 0, sd, car), "not finite"),
        (lambda y, sd, car: (y, sd, 0 * car), "needs two cars or more"),
        (lambda y, sd, car: (y, sd, 2 * car), "without a gap"),
    ],
)
def test_bad_input_is_one_line(change, message: str) -> None:
    y, sd = fleet(1)
    # plain shapes, which the annotations would refuse before the density does
    with pytest.raises(InputError, match=message):
        PopulationMargin(*change(y, sd, CAR))
