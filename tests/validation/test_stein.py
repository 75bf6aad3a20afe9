"""The kernel Stein discrepancy: its kernel by autograd, its null, its power, and what it must not depend on."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.validation.stein import _stein_kernel, stein_discrepancy
from tests.bars import BAR

F64 = torch.float64


class Normal:
    """Three-dimensional normals of the given scale, each window's own ``(window, 3, 3)``."""

    names = ("a", "b", "c")

    def __init__(self, scale: Tensor) -> None:
        self.scale, self.windows = scale, len(scale)
        self.precision = torch.linalg.inv(scale @ scale.mT)

    def log_prob(self, z: Tensor) -> Tensor:
        return -0.5 * torch.einsum("...wi,wij,...wj->...w", z, self.precision, z)

    def initial(self) -> Tensor:
        return torch.zeros(self.windows, 3, dtype=F64)

    def constrain(self, z: Tensor) -> Tensor:
        return z


class Scored(Normal):
    def score(self, z: Tensor) -> Tensor:
        return -torch.einsum("wij,...wj->...wi", self.precision, z)


def standard(windows: int) -> Normal:
    return Scored(torch.eye(3, dtype=F64).expand(windows, 3, 3))


def draws(windows: int, seed: int, shape: tuple[int, int] = (64, 8)) -> Tensor:
    return torch.randn(*shape, windows, 3, generator=torch.Generator().manual_seed(seed), dtype=F64)


def test_kernel_is_that_of_its_definition() -> None:
    x, score = draws(1, 0, (2, 2)).reshape(1, 4, 3), draws(1, 1, (2, 2)).reshape(1, 4, 3)
    found = _stein_kernel(x, score)[0]

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        return (1 + (a - b).square().sum()).rsqrt()

    for i in range(4):
        for j in range(4):
            a, b = x[0, i].clone().requires_grad_(), x[0, j].clone().requires_grad_()
            s, t = score[0, i], score[0, j]
            by_a, by_b = torch.autograd.grad(kernel(a, b), (a, b), create_graph=True)
            mixed = sum(torch.autograd.grad(by_a[k], b, retain_graph=True)[0][k] for k in range(3))
            expected = (s @ t * kernel(a, b) + s @ by_b + t @ by_a + mixed).detach()
            assert abs(float(found[i, j] - expected)) < 1e-12


@pytest.mark.statistical
def test_null_is_what_exact_draws_give(rotating_seed: int, draws_factor: int) -> None:
    windows = 100 * draws_factor
    g = torch.Generator().manual_seed(rotating_seed)
    found = stein_discrepancy(standard(windows), draws(windows, rotating_seed, (32, 8)), generator=g)
    assert found.points == 256
    # KSD^2 of a window scatters by about 30 % of its expectation
    assert abs(float((found.value / found.expected).square().mean()) - 1) < BAR * 0.4 / math.sqrt(windows)
    # uniform p-values
    assert abs(float(found.p_value.double().mean()) - 0.5) < BAR / math.sqrt(12 * windows) + 0.005


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("factor", "shift"),
    [pytest.param(1.2, 0.0, marks=pytest.mark.slow), pytest.param(0.8, 0.0, marks=pytest.mark.slow), (1.0, 0.25)],
)
def test_wrong_draws_are_refused(factor: float, shift: float, rotating_seed: int) -> None:
    z = factor * draws(10, rotating_seed, (128, 8))
    z[..., 0] += shift
    found = stein_discrepancy(standard(10), z, points=1024)
    assert float((found.value / found.expected).mean()) > 1.3
    assert float(found.p_value.double().mean()) < 0.05


def test_it_does_not_depend_on_units_and_takes_autograd_for_a_score(fresh_seed: int) -> None:
    g = torch.Generator().manual_seed(fresh_seed)
    scale = torch.linalg.cholesky(torch.diag_embed(torch.tensor([[1e-3, 1.0, 1e3]], dtype=F64)).expand(2, 3, 3))
    scale = scale + 0.3 * torch.tril(torch.randn(2, 3, 3, generator=g, dtype=F64), -1)
    w = draws(2, fresh_seed)
    z = torch.einsum("wij,cnwj->cnwi", scale, w)
    plain = stein_discrepancy(standard(2), w)
    for density in (Normal(scale), Scored(scale)):
        assert stein_discrepancy(density, z).value == pytest.approx(plain.value.numpy(), rel=1e-4)


@pytest.mark.parametrize(
    ("shape", "points", "used"),
    [((4, 1000), 1000, 1000), ((256, 20), 1000, 768), ((2000, 3), 1000, 1000), ((512, 8), 1000, 512), ((1, 7), 5, 5)],
)
def test_thinning(shape: tuple[int, int], points: int, used: int) -> None:
    assert stein_discrepancy(standard(1), draws(1, 0, shape), points=points, bootstrap=2).points == used


@pytest.mark.slow
@pytest.mark.statistical
def test_autocorrelated_draws_need_a_bootstrap_that_knows(rotating_seed: int) -> None:
    rho, windows = 0.8, 60
    z = draws(windows, rotating_seed, (4, 100))
    for k in range(1, 100):
        z[:, k] = rho * z[:, k - 1] + math.sqrt(1 - rho**2) * z[:, k]
    naive, aware = (
        stein_discrepancy(standard(windows), z, flip=flip, generator=torch.Generator().manual_seed(rotating_seed))
        for flip in (0.5, 0.05)
    )
    # over 24 seeds the means are 0.010 (SD 0.004) and 0.375 (SD 0.041): the bars are more than 5 SDs away
    low, right = (float(found.p_value.double().mean()) for found in (naive, aware))
    assert low < 0.05
    assert right - low > 0.15


def test_bad_arguments() -> None:
    with pytest.raises(InputError, match=r"z: found shape \(8, 2, 3\)"):
        stein_discrepancy(standard(2), draws(2, 0)[0])
    with pytest.raises(InputError, match="points: found 1"):
        stein_discrepancy(standard(2), draws(2, 0), points=1)
    with pytest.raises(InputError, match="flip"):
        stein_discrepancy(standard(2), draws(2, 0), flip=0.9)
