"""Quadrature against laws whose moments, quantiles and evidence are known in closed form, and where it must give up."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from scipy import stats
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.map import Mode
from avtorch.inference.priors import LogSpaceNormal
from avtorch.inference.quadrature import integrate
from tests.bars import LEVEL

F64 = torch.float64


@dataclass(frozen=True)
class Gammas:
    """Independent gamma laws of unit rate, ``(window, parameter)`` shapes; mixed by no correlation, skewed in ``z``."""

    shape: Tensor

    @property
    def names(self) -> tuple[str, ...]:
        return tuple("abcd"[: self.shape.shape[1]])

    @property
    def windows(self) -> int:
        return len(self.shape)

    def log_prob(self, z: Tensor) -> Tensor:
        return (self.shape * z - z.exp() - self.shape.lgamma()).sum(-1)

    def initial(self) -> Tensor:
        return self.shape.log()


@dataclass(frozen=True)
class Normal:
    """A correlated normal in ``z`` behind the face of a density."""

    law: LogSpaceNormal
    height: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        return tuple("abc"[: self.law.mean_z.shape[1]])

    @property
    def windows(self) -> int:
        return len(self.law.mean_z)

    def log_prob(self, z: Tensor) -> Tensor:
        return self.height + self.law.log_prob(z)

    def initial(self) -> Tensor:
        return torch.zeros_like(self.law.mean_z)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_correlated_normal_is_exact(d: int, fresh_seed: int) -> None:
    g = torch.Generator().manual_seed(fresh_seed)
    root = torch.eye(d, dtype=F64) + 0.9 * torch.randn(4, d, d, generator=g, dtype=F64).tril(-1)
    root = 0.2 * root
    mean = torch.randn(4, d, generator=g, dtype=F64)
    cov = root @ root.mT
    found = integrate(Normal(LogSpaceNormal(mean, cov), height=3.0))
    var = cov.diagonal(dim1=-2, dim2=-1)
    exact = (mean + 0.5 * var).exp()
    assert found.converged.all()
    # the grid ends where the density is 1e-9 of its peak, 6.4 SDs out: 1e-10 of the mass, 100 times that in the square
    torch.testing.assert_close(found.mean, exact, rtol=1e-8, atol=0)
    torch.testing.assert_close(found.sd, exact * var.expm1().sqrt(), rtol=1e-6, atol=0)
    torch.testing.assert_close(found.log_evidence, torch.full((4,), 3.0, dtype=F64), rtol=0, atol=1e-9)
    for q in (0.001, 0.05, 0.5, 0.95):
        expected = (mean + stats.norm.ppf(q) * var.sqrt()).exp()
        torch.testing.assert_close(found.quantile(q), expected, rtol=1e-7, atol=0)
        torch.testing.assert_close(found.cdf(expected), torch.full_like(mean, q), rtol=0, atol=1e-9)


@pytest.mark.parametrize(("shape", "nodes"), [([[0.5, 1.0], [2.0, 0.7]], 97), ([[1.5, 4.0, 30.0]], 65)])
def test_skewed_law_is_covered(shape: list[list[float]], nodes: int) -> None:
    """A gamma of shape 0.5 has an exponential tail in ``z`` that leaves the first grid: it must move and grow."""
    expected = torch.tensor(shape, dtype=F64)
    found = integrate(Gammas(expected), nodes=nodes)
    assert found.converged.all()
    # the error by leaving out nodes is below the tolerance of 0.03, that of the whole grid about its square
    torch.testing.assert_close(found.mean, expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.sd, expected.sqrt(), rtol=1e-4, atol=0)
    torch.testing.assert_close(found.log_evidence, torch.zeros(len(shape), dtype=F64), rtol=0, atol=1e-4)
    for q in (0.05, 0.5, 0.95):
        exact = torch.from_numpy(stats.gamma.ppf(q, expected.numpy()))
        assert (((found.quantile(q) - exact) / expected.sqrt()).abs() < 2e-3).all()


def test_error_bounds_what_a_finer_grid_changes() -> None:
    shape = torch.tensor([[0.5, 1.0], [2.0, 0.7], [40.0, 3.0]], dtype=F64)
    fine = integrate(Gammas(shape), nodes=201)
    errors = []
    for nodes in (17, 33, 65, 97):
        rough = integrate(Gammas(shape), nodes=nodes)
        actual = torch.stack(
            [
                ((rough.mean - fine.mean) / fine.sd).abs().amax(-1),
                (rough.sd / fine.sd - 1).abs().amax(-1),
                (rough.log_evidence - fine.log_evidence).abs(),
            ]
        ).amax(0)
        resolved = rough.error < 0.1
        assert (actual <= rough.error + 1e-6)[resolved].all()
        assert not rough.converged[~resolved].any()
        errors.append(rough.error)
    assert (errors[-1] < 0.02 * errors[0]).all()
    assert not integrate(Gammas(shape), nodes=9).converged.any()
    assert fine.converged.all()


def test_a_poor_start_is_mended() -> None:
    """From a mode two SDs off and a curvature four times too tight or too wide, the same answer."""
    law = LogSpaceNormal(torch.zeros(1, 2, dtype=F64), torch.tensor([[[0.04, 0.03], [0.03, 0.09]]], dtype=F64))
    density = Normal(law)
    for wrong in (0.5, 2.0):
        z = torch.tensor([[0.4, -0.6]], dtype=F64)
        mode = Mode(z, wrong * torch.linalg.cholesky(law.cov_z), density.log_prob(z), torch.tensor([True]))
        found = integrate(density, mode=mode)
        assert found.converged.all()
        expected = torch.tensor([[math.exp(0.02), math.exp(0.045)]], dtype=F64)
        torch.testing.assert_close(found.mean, expected, rtol=1e-8, atol=0)


def test_mass_without_end_is_flagged() -> None:
    """A density that never falls off to one side: its window is flagged, its neighbour is not."""

    class Shelf(Normal):
        def log_prob(self, z: Tensor) -> Tensor:
            flat = torch.nn.functional.logsigmoid(z[..., :1, :]).sum(-1)
            return torch.cat([flat, super().log_prob(z)[..., 1:]], -1)

    cov = 0.04 * torch.eye(2, dtype=F64).expand(2, 2, 2)
    density = Shelf(LogSpaceNormal(torch.zeros(2, 2, dtype=F64), cov))
    mode = Mode(
        torch.zeros(2, 2, dtype=F64), 0.2 * torch.eye(2, dtype=F64).expand(2, 2, 2), torch.zeros(2), cov[:, 0, 0] > 0
    )
    found = integrate(density, mode=mode)
    assert found.converged.tolist() == [False, True]
    assert found.edge[0] > 0.1


@pytest.mark.statistical
def test_cdf_is_uniform_over_draws_of_the_law(rotating_seed: int, draws_factor: int) -> None:
    shape = torch.tensor([[0.8, 4.0]], dtype=F64)
    draws = stats.gamma.rvs(shape.numpy(), size=(2000 * draws_factor, 1, 2), random_state=rotating_seed)
    u = integrate(Gammas(shape)).cdf(torch.from_numpy(draws))
    for i in range(2):
        assert stats.kstest(u[:, 0, i].numpy(), "uniform").pvalue > LEVEL


def test_bad_input_names_itself() -> None:
    with pytest.raises(InputError, match="density: 4 parameters"):
        integrate(Gammas(torch.ones(1, 4, dtype=F64)))
    for nodes in (7, 48):
        with pytest.raises(InputError, match=f"nodes: {nodes}"):
            integrate(Gammas(torch.ones(1, 2, dtype=F64)), nodes=nodes)
    found = integrate(Gammas(torch.ones(1, 2, dtype=F64)), nodes=33)
    with pytest.raises(InputError, match="q: 1"):
        found.quantile(1.0)
