"""SGHMC: its law against the closed form of its own discretisation, and its manners as a torch optimizer."""

from __future__ import annotations

import copy
import io
import math

import numpy as np
import pytest
import torch
from scipy.linalg import solve_discrete_lyapunov
from torch import Tensor
from torch.optim.lr_scheduler import StepLR

from avtorch.errors import InputError
from avtorch.inference import SGLD
from avtorch.inference.sghmc import SGHMC
from tests.bars import BAR

F64 = torch.float64


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def leaf(seed: int, *shape: int, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=dtype).requires_grad_()


def energy(x: Tensor) -> Tensor:
    """Anharmonic, one entry per leading index."""
    return (0.5 * x.square() + 0.3 * torch.cos(2 * x)).sum(-1) + 0.1 * x.prod(-1)


def transition(h: float, precision: float, friction: float, s2: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """``(theta, v) -> M (theta, v) + noise`` of covariance ``Q``: one step on a Gaussian, as the docstring has it."""
    eps = math.sqrt(h)
    c = math.exp(-friction * eps)
    kick = np.array([[1.0, 0.0], [-eps * precision, 1.0]])
    drift = np.array([[1.0, eps / 2], [0.0, 1.0]])
    after_kick = drift @ np.diag([1.0, c]) @ drift
    noise = drift @ np.diag([0.0, 1 - c**2]) @ drift.T + after_kick @ np.diag([0.0, h * s2]) @ after_kick.T
    return after_kick @ kick, noise


CASES = [
    (h, p, friction, s)
    for h, p in ((0.1, 1.0), (0.8, 3.0), (2.0, 0.5))
    for friction in (0.5, 2.0, math.inf)
    for s in (0.0, 2.0)
]


@pytest.mark.parametrize(("h", "p", "friction", "s"), CASES)
def test_the_stated_variance_is_that_of_the_scheme(h, p, friction, s):
    """The docstring's closed form solves the discrete Lyapunov equation of one step."""
    covariance = solve_discrete_lyapunov(*transition(h, p, friction, s**2))
    c = math.exp(-friction * math.sqrt(h))
    stated = (1 + h * s**2 * (1 + c) / (4 * (1 - c) * (1 - h * p / 4))) / p
    assert covariance[0, 0] == pytest.approx(stated, rel=1e-10)


@pytest.mark.statistical
def test_a_chain_at_its_stationary_law_keeps_it(rotating_seed, draws_factor):
    """Covariance of place and velocity and the lagged one, one group a case, after 1, 2 and 10 steps; 5 sigma."""
    g, chains = generator(rotating_seed), 50_000 * draws_factor
    laws = [transition(h, p, friction, s**2) for h, p, friction, s in CASES]
    covariances = [torch.from_numpy(solve_discrete_lyapunov(*law)) for law in laws]
    places, velocities, groups = [], [], []
    for (h, _, friction, _), covariance in zip(CASES, covariances, strict=True):
        start = torch.randn(chains, 2, generator=g, dtype=F64) @ torch.linalg.cholesky(covariance).mT
        x = start[:, 0].clone().requires_grad_()
        places.append(x)
        velocities.append(start[:, 1].clone())
        groups.append({"params": [x], "lr": h, "friction": friction})
    optimizer = SGHMC(groups, 1.0, generator=g)
    for x, v in zip(places, velocities, strict=True):
        optimizer.state[x]["velocity"] = v

    def potential() -> Tensor:
        total = torch.zeros(chains, dtype=F64)
        for x, (_, p, _, s) in zip(places, CASES, strict=True):
            total = total + 0.5 * p * x.square()
            if s:
                total = total + s * torch.randn(chains, generator=g, dtype=F64) * x
        return total

    def now() -> list[Tensor]:
        return [torch.stack([x.detach(), optimizer.state[x]["velocity"]], -1) for x in places]

    for k in range(1, 11):
        before = now()
        optimizer.step(potential)
        if k not in (1, 2, 10):
            continue
        for case, new, old, law, covariance in zip(CASES, now(), before, laws, covariances, strict=True):
            lagged = torch.from_numpy(law[0]) @ covariance
            variances = covariance.diagonal()
            spread = torch.outer(variances, variances)
            for measured, expected in ((new.mT @ new, covariance), (new.mT @ old, lagged)):
                # the product of two Gaussians of covariance S_ij has variance S_ii S_jj + S_ij^2
                error = ((spread + expected.square()) / chains).sqrt()
                assert ((measured / chains - expected) / error).abs().max() < BAR, (case, k)
            assert (new.mean(0) / (variances / chains).sqrt()).abs().max() < BAR, (case, k)


@pytest.mark.statistical
def test_the_stationary_variance_is_reached_and_scales_with_temperature(rotating_seed, draws_factor):
    """From a point, full gradients: the Gaussian's own variance, and half of it at temperature 1/2."""
    g, chains, p, h = generator(rotating_seed), 100_000 * draws_factor, 2.0, 0.8
    x, y = (torch.zeros(chains, dtype=F64, requires_grad=True) for _ in range(2))
    optimizer = SGHMC([{"params": [x]}, {"params": [y], "temperature": 0.5}], h, generator=g)
    for _ in range(40):
        optimizer.step(lambda: 0.5 * p * (x.square() + y.square()))
    # what is left of the start: the spectral radius of the step, squared, per step
    radius = np.abs(np.linalg.eigvals(transition(h, p, 2.0)[0])).max()
    assert radius**80 < 1e-3
    for place, expected in ((x, 1 / p), (y, 0.5 / p)):
        variance = place.detach().square().mean().item()
        assert abs(variance / expected - 1) < BAR * math.sqrt(2 / chains) + 1e-3


def test_infinite_friction_is_sgld_with_averaged_noise():
    """Same draws, same path: the velocity's draws are the averaged noise."""
    x = leaf(1, 5, 3)
    y = x.detach().clone().requires_grad_()
    ours, theirs = (
        SGHMC([x], 0.4, friction=math.inf, generator=generator(7)),
        SGLD([y], 0.4, noise="averaged", generator=generator(7)),
    )
    first = torch.randn(5, 3, generator=theirs.generator, dtype=F64)
    # SGLD draws its own noise before the shared one; here the shared one comes first
    fresh = torch.randn(5, 3, generator=theirs.generator, dtype=F64)
    (gradient,) = torch.autograd.grad(energy(y).sum(), y)
    expected = y.detach() - 0.2 * gradient + math.sqrt(0.4) * 0.5 * (first + fresh)
    ours.step(lambda: energy(x))
    torch.testing.assert_close(x.detach(), expected, rtol=1e-14, atol=1e-14)
    with torch.no_grad():
        y.copy_(x)
    theirs.state[y]["noise"] = fresh
    for _ in range(20):
        ours.step(lambda: energy(x))
        theirs.step(lambda: energy(y))
    torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


def test_zero_temperature_is_descent_with_momentum():
    h, friction, x = 0.3, 1.2, leaf(2, 5, 3)
    y = x.detach().clone().requires_grad_()
    c = math.exp(-friction * math.sqrt(h))
    ours = SGHMC([x], h, friction=friction, temperature=0.0)
    theirs = torch.optim.SGD([y], h * (1 + c) / 2, momentum=c)
    for _ in range(50):
        ours.step(lambda: energy(x))
        theirs.zero_grad()
        energy(y).sum().backward()
        theirs.step()
        torch.testing.assert_close(x, y, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_one_step_is_the_law(dtype):
    h, friction, temperature, x = 0.3, 1.5, 0.49, leaf(3, 4, 3, dtype=dtype)
    place = x.detach().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(energy(place).sum(), place)
    g = generator(9)
    v, xi = (torch.randn(4, 3, generator=g, dtype=dtype) for _ in range(2))
    eps = math.sqrt(h)
    c = math.exp(-friction * eps)
    v = math.sqrt(temperature) * v - eps * gradient
    half = place.detach() + eps / 2 * v
    v = c * v + math.sqrt((1 - c**2) * temperature) * xi
    SGHMC([x], h, friction=friction, temperature=temperature, generator=generator(9)).step(lambda: energy(x))
    assert x.dtype == dtype
    tolerance = 8 * torch.finfo(dtype).eps
    torch.testing.assert_close(x.detach(), half + eps / 2 * v, rtol=tolerance, atol=tolerance)


OPTIONS = [{}, {"friction": math.inf}, {"maximize": True, "foreach": True, "temperature": 0.5}]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda o: "-".join(map(str, o)) or "plain")
def test_resume_is_equal_to_the_bit(options):
    """20 steps in one go, or 8, through a file read without running code, then 12; with a generator and a scheduler."""

    def build(x: Tensor, y: Tensor, seed: int):
        groups = [{"params": [x]}, {"params": [y], "lr": 0.02, "friction": 0.3}]
        optimizer = SGHMC(groups, 0.05, generator=generator(seed), **options)
        return optimizer, StepLR(optimizer, 5, gamma=0.7)

    def advance(x: Tensor, y: Tensor, optimizer: SGHMC, scheduler: StepLR, steps: int) -> None:
        sign = -1.0 if options.get("maximize") else 1.0
        for _ in range(steps):
            optimizer.step(lambda: sign * (energy(x) + energy(y)))
            scheduler.step()

    x, y = leaf(4, 6, 2), leaf(5, 6, 3)
    p, q = x.detach().clone().requires_grad_(), y.detach().clone().requires_grad_()
    optimizer, scheduler = build(x, y, 11)
    advance(x, y, optimizer, scheduler, 20)

    optimizer, scheduler = build(p, q, 11)
    advance(p, q, optimizer, scheduler, 8)
    file = io.BytesIO()
    torch.save({"p": p, "q": q, "sghmc": optimizer.state_dict(), "lr": scheduler.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    p, q = (saved[k].detach().clone().requires_grad_() for k in "pq")
    optimizer, scheduler = build(p, q, 99)
    optimizer.load_state_dict(saved["sghmc"])
    scheduler.load_state_dict(saved["lr"])
    advance(p, q, optimizer, scheduler, 12)
    assert p.equal(x)
    assert q.equal(y)


def test_resume_brings_its_generator_along_and_a_deep_copy_walks_on_alike():
    x = leaf(4, 6)
    optimizer = SGHMC([x], 0.1, generator=generator(3))
    optimizer.step(lambda: energy(x))
    y = x.detach().clone().requires_grad_()
    resumed = SGHMC([y], 0.1)
    resumed.load_state_dict(optimizer.state_dict())
    twin = copy.deepcopy(optimizer)
    z = twin.param_groups[0]["params"][0]
    optimizer.step(lambda: energy(x))
    resumed.step(lambda: energy(y))
    twin.step(lambda: energy(z))
    assert x.equal(y)
    assert x.equal(z)


@pytest.mark.parametrize("options", OPTIONS[:2], ids=lambda o: "-".join(map(str, o)) or "plain")
def test_foreach_equals_the_loop_and_maximize_the_negative(options):
    runs = []
    for extra in ({}, {"foreach": True}, {"maximize": True}):
        x, y = leaf(6, 5, 2), leaf(7, 5, 4)
        sign = -1.0 if extra.get("maximize") else 1.0
        optimizer = SGHMC([x, y], 0.05, generator=generator(1), **options, **extra)
        for _ in range(10):
            optimizer.step(lambda x=x, y=y, sign=sign: sign * (energy(x) + energy(y)))
        runs.append((x, y))
    for other in runs[1:]:
        # the same operations, perhaps contracted: a few roundings a step
        torch.testing.assert_close(other, runs[0], rtol=1e-13, atol=1e-13)


def test_every_closure_moves_the_chains_alike():
    """Summed, per (chain, window), calling backward itself, or no closure at all."""
    ends, returned = [], []
    for kind in ("sum", "chain-window", "backward", "none"):
        x = leaf(8, 4, 3, 2)
        optimizer = SGHMC([x], 0.1, generator=generator(5))

        def closure(x=x, optimizer=optimizer, kind=kind):
            if kind == "chain-window":
                return energy(x)
            total = energy(x).sum()
            if kind == "sum":
                return total
            optimizer.zero_grad()
            total.backward()
            return total

        for _ in range(3):
            if kind == "none":
                closure()
                returned.append(optimizer.step())
            else:
                returned.append(optimizer.step(closure))
        ends.append(x.detach())
    assert all(end.equal(ends[0]) for end in ends)
    assert returned[3].shape == (4, 3)
    assert returned[-1] is None


def test_a_parameter_without_a_part_in_u_or_with_step_zero_stays():
    x, y, z = leaf(1, 3), leaf(2, 3), leaf(3, 3)
    still = y.detach().clone(), z.detach().clone()
    optimizer = SGHMC([{"params": [x, y]}, {"params": [z], "lr": 0.0, "friction": math.inf}], 0.1)
    optimizer.step(lambda: x.square().sum() + z.square().sum())
    assert y.equal(still[0])
    assert z.equal(still[1])


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"lr": -0.1}, "lr"),
        ({"lr": math.nan}, "lr"),
        ({"lr": math.inf}, "lr"),
        ({"friction": 0.0}, "friction"),
        ({"friction": math.nan}, "friction"),
        ({"temperature": -1.0}, "temperature"),
    ],
)
def test_bad_options_are_refused_by_name(options, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        SGHMC([leaf(1, 2)], **{"lr": 0.1, **options})
    with pytest.raises(InputError, match=rf"^{name}: "):
        SGHMC([{"params": [leaf(1, 2)], **options}], 0.1)
