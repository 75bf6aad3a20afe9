"""The mode against SciPy's optimizer, Laplace covariance against the inverse Hessian, hard starts, no mode at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from avtorch.inference import JerkDensity, find_mode
from avtorch.inference.priors import Joint, QuadrantNormal, default_jerk_noise_prior

F64 = torch.float64
AMPLITUDES = [0.0, 0.02, 0.1, 0.3, 1.0, 3.0]


def densities(make_windows, seed: int) -> dict[str, JerkDensity]:
    w = make_windows(seed, AMPLITUDES, T=[0.1, 0.2, 0.3, 0.6, 1.5, 2.0], K=[1.0, 0.9, 0.8, 1.1, 0.5, 0.7])
    mean = torch.tensor([[0.4, 0.9]], dtype=F64).repeat(len(AMPLITUDES), 1)
    quadrant = Joint(QuadrantNormal(mean, 0.25), default_jerk_noise_prior())
    return {"first": JerkDensity(w.statistics), "lambda": JerkDensity(w.statistics, quadrant)}


def one_window(density: JerkDensity, w: int):
    """Potential and gradient of one window in NumPy's terms."""
    alone = JerkDensity(density.statistics.select(torch.tensor([w])), density.prior.select(torch.tensor([w])))

    def potential(x: np.ndarray) -> tuple[float, np.ndarray]:
        z = torch.from_numpy(x)[None].requires_grad_()
        value = -alone.log_prob(z).sum()
        (gradient,) = torch.autograd.grad(value, z)
        return value.item(), gradient[0].numpy()

    return potential


@pytest.mark.parametrize("kind", ["first", "lambda"])
def test_mode_is_scipys(kind, make_windows, fresh_seed):
    density = densities(make_windows, fresh_seed)[kind]
    mode = find_mode(density)
    assert mode.converged.all()
    sd = mode.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    for w in range(density.windows):
        potential = one_window(density, w)
        # from the truth's side of the prior, with no knowledge of our start
        options = {"maxiter": 3000, "ftol": 1e-15, "gtol": 1e-9}
        starts = (np.log([0.3, 1.0, 0.1]), np.log([1.0, 0.7, 0.5]))
        ends = [minimize(potential, x0, jac=True, method="L-BFGS-B", options=options) for x0 in starts]
        best = min(ends, key=lambda r: r.fun)
        # neither ends more than 1e-6 above the mode: sqrt(2e-6) of an SD, twice
        assert -mode.log_prob[w].item() <= best.fun + 1e-6
        assert (mode.z[w] - torch.from_numpy(best.x)).abs().div(sd[w]).max() < 5e-3


@pytest.mark.parametrize("kind", ["first", "lambda"])
def test_laplace_covariance_is_the_inverse_hessian(kind, make_windows, fresh_seed):
    density = densities(make_windows, fresh_seed)[kind]
    mode = find_mode(density)
    for w in range(density.windows):

        def potential(x: Tensor, w: int = w) -> Tensor:
            return -density.log_prob(mode.z.index_put((torch.tensor([w]),), x[None]))[w]

        hessian = torch.autograd.functional.hessian(potential, mode.z[w])
        assert isinstance(hessian, Tensor)
        # whitened: relative to the posterior itself, however correlated
        whitened = mode.scale[w].mT @ hessian @ mode.scale[w]
        torch.testing.assert_close(whitened, torch.eye(3, dtype=F64), rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    "start", [[0.02, 0.05, 1e-3], [5.0, 3.0, 5.0], [0.02, 3.0, 1e-3], [5.0, 0.05, 1e-2], [1e-3, 30.0, 100.0]]
)
def test_hard_starts_end_at_the_same_mode(start, make_windows):
    density = densities(make_windows, 3)["first"]
    easy = find_mode(density)
    hard = find_mode(density, start=torch.tensor(start, dtype=F64).log().expand(density.windows, 3), iterations=200)
    assert hard.converged.all()
    torch.testing.assert_close(hard.log_prob, easy.log_prob, rtol=0, atol=1e-6)


def test_windows_do_not_disturb_each_other(make_windows):
    density = densities(make_windows, 4)["first"]
    together = find_mode(density)
    for w in range(density.windows):
        index = torch.tensor([w])
        alone = find_mode(JerkDensity(density.statistics.select(index)))
        torch.testing.assert_close(alone.log_prob[0], together.log_prob[w], rtol=0, atol=1e-7)


class Shaped:
    """A density over one parameter from a function of ``z``."""

    names = ("x",)
    windows = 3

    def __init__(self, function) -> None:
        self.function = function

    def log_prob(self, z: Tensor) -> Tensor:
        return self.function(z[..., 0])

    def initial(self) -> Tensor:
        return torch.tensor([[-1.0], [0.5], [2.0]], dtype=F64)


@pytest.mark.parametrize(
    "function",
    [
        lambda z: z,  # climbs for ever
        lambda z: 0.0 * z,  # flat
        lambda z: z.square(),  # a valley in place of a hill
        lambda z: z * math.nan,
        lambda z: torch.where(z > -9, -torch.inf, z),
    ],
)
def test_no_mode_is_said_not_made_up(function):
    mode = find_mode(Shaped(function))
    assert not mode.converged.any()
    assert mode.z.isfinite().all()
    assert mode.scale.isfinite().all()


def test_a_hill_beside_a_cliff_is_climbed():
    """Undefined beyond z = 1.1 with the mode at 1: steps that fall off are shortened, not taken."""
    mode = find_mode(Shaped(lambda z: torch.where(z < 1.1, -50 * (z - 1).square() + 0.01 * z, torch.nan)))
    assert mode.converged[:2].all()
    torch.testing.assert_close(mode.z[:2, 0], torch.full((2,), 1.0 + 1e-4, dtype=F64), rtol=0, atol=1e-4)
    # the third starts where nothing is defined
    assert not mode.converged[2]
