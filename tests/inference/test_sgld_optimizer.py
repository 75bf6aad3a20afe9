"""SGLD as a torch optimizer: SGD at zero temperature, resume to the bit, groups, schedulers, closures, bad options."""

from __future__ import annotations

import copy
import io
import math

import pytest
import torch
from torch import Tensor
from torch.optim.lr_scheduler import CosineAnnealingLR, ExponentialLR, StepLR

from avtorch.errors import InputError
from avtorch.inference import SGLD
from avtorch.inference.sgld import harmonic, polynomial

F64 = torch.float64


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def leaf(seed: int, *shape: int, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=dtype).requires_grad_()


def energy(x: Tensor) -> Tensor:
    """Anharmonic, one entry per leading index."""
    return (0.5 * x.square() + 0.3 * torch.cos(2 * x)).sum(-1) + 0.1 * x.prod(-1)


def test_zero_temperature_is_sgd_with_half_the_step():
    h, a = 0.13, leaf(1, 5, 3)
    b = a.detach().clone().requires_grad_()
    ours, theirs = SGLD([a], h, temperature=0.0), torch.optim.SGD([b], h / 2)
    for _ in range(50):
        ours.step(lambda: energy(a))
        theirs.zero_grad()
        energy(b).sum().backward()
        theirs.step()
        assert a.equal(b)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_one_step_is_the_law(dtype):
    """theta - (h/2) grad U + sqrt(h T) xi with xi the generator's next normals, in the dtype of the parameter."""
    h, temperature, x = 0.3, 0.49, leaf(2, 4, 3, dtype=dtype)
    before = x.detach().clone().requires_grad_()
    energy(before).sum().backward()
    xi = torch.randn(4, 3, generator=generator(9), dtype=dtype)
    expected = before.detach() - h / 2 * before.grad + math.sqrt(h * temperature) * xi
    SGLD([x], h, temperature=temperature, generator=generator(9)).step(lambda: energy(x))
    assert x.dtype == dtype
    tolerance = 4 * torch.finfo(dtype).eps
    torch.testing.assert_close(x.detach(), expected, rtol=tolerance, atol=tolerance)


def test_averaged_noise_shares_a_draw_between_neighbouring_steps():
    h, x = 0.3, leaf(3, 4)
    start = x.detach().clone()
    draws = torch.randn(4, 4, generator=generator(9), dtype=F64)
    # the first step needs two draws: its own comes first
    order = [1, 0, 2, 3]
    g = generator(9)
    rows = torch.stack([torch.randn(4, generator=g, dtype=F64) for _ in range(4)])[order]
    assert rows.shape == draws.shape
    optimizer = SGLD([x], h, noise="averaged", generator=generator(9))
    for _ in range(3):
        optimizer.step(lambda: 0.0 * x.sum())
    total = math.sqrt(h) * (0.5 * rows[0] + rows[1] + rows[2] + 0.5 * rows[3])
    torch.testing.assert_close(x.detach(), start + total, rtol=1e-14, atol=1e-14)


OPTIONS = [
    {},
    {"noise": "averaged"},
    {"preconditioner": "rmsprop", "chain_dims": 1},
    {"preconditioner": "rmsprop", "noise": "averaged", "alpha": 0.9, "eps": 0.1},
    {"maximize": True, "foreach": True, "temperature": 0.5},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda o: "-".join(map(str, o)) or "plain")
def test_resume_is_equal_to_the_bit(options):
    """20 steps in one go, or 8, through a file read without running code, then 12; with a generator and a scheduler."""

    def build(x: Tensor, y: Tensor, seed: int):
        groups = [{"params": [x]}, {"params": [y], "lr": 0.02, "noise": "averaged"}]
        optimizer = SGLD(groups, 0.05, generator=generator(seed), **options)
        return optimizer, StepLR(optimizer, 5, gamma=0.7)

    def advance(x: Tensor, y: Tensor, optimizer: SGLD, scheduler: StepLR, steps: int) -> None:
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
    torch.save({"p": p, "q": q, "sgld": optimizer.state_dict(), "lr": scheduler.state_dict()}, file)
    file.seek(0)
    saved = torch.load(file, weights_only=True)
    p, q = (saved[k].detach().clone().requires_grad_() for k in "pq")
    optimizer, scheduler = build(p, q, 99)
    optimizer.load_state_dict(saved["sgld"])
    scheduler.load_state_dict(saved["lr"])
    advance(p, q, optimizer, scheduler, 12)
    assert p.equal(x)
    assert q.equal(y)


def test_a_deep_copy_walks_on_alike():
    x = leaf(4, 6)
    optimizer = SGLD([x], 0.1, noise="averaged", generator=generator(3))
    optimizer.step(lambda: energy(x))
    twin = copy.deepcopy(optimizer)
    y = twin.param_groups[0]["params"][0]
    optimizer.step(lambda: energy(x))
    twin.step(lambda: energy(y))
    assert x.equal(y)
    assert x is not y


@pytest.mark.parametrize("options", OPTIONS[:4], ids=lambda o: "-".join(map(str, o)) or "plain")
def test_foreach_equals_the_loop(options):
    x, y = leaf(6, 5, 2), leaf(7, 5, 4)
    p, q = x.detach().clone().requires_grad_(), y.detach().clone().requires_grad_()
    loop = SGLD([x, y], 0.05, generator=generator(1), **options)
    fused = SGLD([p, q], 0.05, generator=generator(1), foreach=True, **options)
    for _ in range(10):
        loop.step(lambda: energy(x) + energy(y))
        fused.step(lambda: energy(p) + energy(q))
    # the same operations, perhaps contracted: a few roundings a step
    torch.testing.assert_close(p, x, rtol=1e-13, atol=1e-13)
    torch.testing.assert_close(q, y, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("options", OPTIONS[:4], ids=lambda o: "-".join(map(str, o)) or "plain")
def test_maximize_equals_minimising_the_negative(options):
    x = leaf(6, 5, 2)
    y = x.detach().clone().requires_grad_()
    down = SGLD([x], 0.05, generator=generator(1), **options)
    up = SGLD([y], 0.05, generator=generator(1), maximize=True, **options)
    for _ in range(10):
        down.step(lambda: energy(x))
        up.step(lambda: -energy(y))
    assert x.equal(y)


def test_every_closure_moves_the_chains_alike():
    """Summed, per (chain, window), calling backward itself, leaving only gradients, or no closure at all."""
    start = leaf(8, 4, 3, 2).detach()
    ends, returned = [], []
    for kind in ("sum", "chain-window", "backward", "gradient", "none"):
        x = start.clone().requires_grad_()
        optimizer = SGLD([x], 0.1, generator=generator(5))

        def closure(x=x, optimizer=optimizer, kind=kind):
            if kind == "chain-window":
                return energy(x)
            total = energy(x).sum()
            if kind == "sum":
                return total
            optimizer.zero_grad()
            total.backward()
            return total if kind == "backward" else None

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


def test_the_closures_value_is_returned_under_no_grad():
    x = leaf(8, 4)
    with torch.no_grad():
        value = SGLD([x], 0.1).step(lambda: x.square().sum())
    assert value.item() > 0


def test_groups_have_their_own_options():
    x, y = leaf(1, 3), leaf(2, 3)
    still = y.detach().clone()
    optimizer = SGLD([{"params": [x], "temperature": 0.0}, {"params": [y], "lr": 0.0}], 0.1)
    expected = x.detach() - 0.05 * 2 * x.detach()
    optimizer.step(lambda: x.square().sum() + y.square().sum())
    torch.testing.assert_close(x.detach(), expected, rtol=1e-15, atol=1e-15)
    assert y.equal(still)


def test_a_parameter_without_a_part_in_u_stays():
    x, y = leaf(1, 3), leaf(2, 3)
    still = y.detach().clone()
    SGLD([x, y], 0.1).step(lambda: x.square().sum())
    assert y.equal(still)


@pytest.mark.parametrize(
    ("build", "expected"),
    [
        (lambda o: StepLR(o, 2, gamma=0.5), [0.4, 0.4, 0.2, 0.2, 0.1]),
        (lambda o: ExponentialLR(o, 0.5), [0.4 * 0.5**k for k in range(5)]),
        (lambda o: CosineAnnealingLR(o, 4), [0.2 * (1 + math.cos(math.pi * k / 4)) for k in range(5)]),
        (harmonic, [0.4 / k for k in range(1, 6)]),
        (polynomial, [0.4 * (1 + k / 100) ** (-1 / 3) for k in range(5)]),
        (lambda o: polynomial(o, b=2.0, gamma=0.55), [0.4 * (1 + k / 2) ** -0.55 for k in range(5)]),
    ],
)
def test_the_step_and_the_noise_follow_any_scheduler(build, expected):
    x = torch.zeros(3, dtype=F64, requires_grad=True)
    optimizer = SGLD([x], 0.4, generator=generator(2))
    scheduler = build(optimizer)
    source, position = generator(2), torch.zeros(3, dtype=F64)
    for h in expected:
        optimizer.step(lambda: (3 * x).sum())
        scheduler.step()
        position = position - 0.5 * h * 3 + math.sqrt(h) * torch.randn(3, generator=source, dtype=F64)
        torch.testing.assert_close(x.detach(), position, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(("options", "name"), [({"b": 0.0}, "b"), ({"gamma": 0.0}, "gamma"), ({"gamma": 1.1}, "gamma")])
def test_bad_schedules_are_refused(options, name):
    optimizer = SGLD([leaf(1, 2)], 0.1)
    with pytest.raises(InputError, match=rf"^{name}: "):
        polynomial(optimizer, **options)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"lr": -0.1}, "lr"),
        ({"lr": math.nan}, "lr"),
        ({"lr": math.inf}, "lr"),
        ({"temperature": -1.0}, "temperature"),
        ({"noise": "pink"}, "noise"),
        ({"preconditioner": "adam"}, "preconditioner"),
        ({"alpha": 1.0}, "alpha"),
        ({"eps": 0.0}, "eps"),
        ({"chain_dims": -1}, "chain_dims"),
    ],
)
def test_bad_options_are_refused_by_name(options, name):
    with pytest.raises(InputError, match=rf"^{name}: "):
        SGLD([leaf(1, 2)], **{"lr": 0.1, **options})
    with pytest.raises(InputError, match=rf"^{name}: "):
        SGLD([{"params": [leaf(1, 2)], **options}], 0.1)


def test_the_preconditioner_reports_what_it_needs():
    x = leaf(1, 2)
    optimizer = SGLD([x], 0.1, preconditioner="rmsprop")
    with pytest.raises(InputError, match=r"^closure: needed"):
        optimizer.step()

    def closure():
        value = x.square().sum()
        value.backward()
        return value

    with pytest.raises(InputError, match="without calling backward"):
        optimizer.step(closure)
