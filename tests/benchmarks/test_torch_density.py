"""Any log density in torch: constraints, Jacobians, and what is refused."""

from __future__ import annotations

import pytest
import torch
from torch.distributions import Beta, Gamma, Normal
from torch.distributions.constraints import interval, positive, real, simplex, unit_interval

from avtorch.errors import InputError
from avtorch.inference import SamplerSettings, sample
from avtorch.inference.density import ConstrainedDensity, Density
from benchmarks.torch_density import TorchDensity
from tests.bars import BAR

F64 = torch.float64


def three() -> TorchDensity:
    """Independent laws with moments in closed form, one a constraint."""

    def log_density(p):
        return (
            Normal(-2.0, 0.5).log_prob(p["x"])
            + Gamma(9.0, 2.0).log_prob(p["rate"])
            + Beta(8.0, 4.0).log_prob(p["share"])
        )

    return TorchDensity(log_density, {"x": real, "rate": positive, "share": unit_interval})


def test_the_jacobian_is_counted_once():
    """The density over z is that over the parameters times |d parameter / d z|, by finite differences."""
    density = three()
    assert isinstance(density, Density)
    assert isinstance(density, ConstrainedDensity)
    z = torch.tensor([[[0.3, -0.7, 0.4]], [[-1.0, 1.2, -2.0]]], dtype=F64)
    h = 1e-6
    slope = (density.constrain(z + h) - density.constrain(z - h)) / (2 * h)
    value = density.constrain(z)
    plain = density.log_density(dict(zip(density.names, value.unbind(-1), strict=True)))
    # central differences in float64 are good to about h^2 and eps / h
    assert torch.allclose(density.log_prob(z), plain + slope.log().sum(-1), atol=1e-8)


@pytest.mark.statistical
def test_it_is_sampled_in_its_own_units(rotating_seed, draws_factor):
    posterior = sample(
        three(), SamplerSettings(chains=2048 * draws_factor), generator=torch.Generator().manual_seed(rotating_seed)
    )
    assert posterior.converged.all()
    mean = torch.tensor([-2.0, 4.5, 2 / 3], dtype=F64)
    sd = torch.tensor([0.5, 1.5, (32 / (144 * 13)) ** 0.5], dtype=F64)
    chains = posterior.draws[:, :, 0].mean(1)
    error = chains.std(0) / len(chains) ** 0.5
    # 0.01 SDs for the bias of the step
    assert ((chains.mean(0) - mean).abs() < BAR * error + 0.01 * sd).all()
    squares = ((posterior.draws[:, :, 0] - mean) / sd).square().mean(1)
    assert ((squares.mean(0) - 1).abs() < BAR * squares.std(0) / len(squares) ** 0.5 + 0.02).all()


def test_it_starts_at_the_given_point():
    density = TorchDensity(lambda p: -p["x"], {"x": interval(2.0, 5.0)}, start={"x": 4.0})
    assert density.constrain(density.initial()).item() == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("parameters", "start", "message"),
    [
        ({}, None, "^parameters: none named"),
        ({"p": simplex}, None, "^parameters: the constraint of p"),
        ({"x": real, "y": real}, {"x": 0.0}, "^start: y is missing"),
        ({"x": positive}, {"x": -1.0}, "^start: x = -1 breaks"),
    ],
)
def test_bad_parameters_are_refused_by_name(parameters, start, message):
    with pytest.raises(InputError, match=message):
        TorchDensity(lambda p: torch.zeros(()), parameters, start=start)
