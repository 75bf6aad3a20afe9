"""Linear recursions over whole drives against plain loops."""

from __future__ import annotations

import time

import pytest
import torch

from avtorch.gap.simulator.recursion import scan, scan_pair

D = torch.float64


def looped(alpha: torch.Tensor, beta: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    rows = []
    for k in range(beta.shape[-1]):
        x = alpha[..., k if alpha.shape[-1] > 1 else 0] * x + beta[..., k]
        rows.append(x)
    return torch.stack(rows, -1)


@pytest.mark.parametrize("steps", [1, 2, 100, 1025])
@pytest.mark.parametrize("constant", [False, True])
@pytest.mark.parametrize("inference", [False, True])
def test_scan_is_the_loop(steps: int, constant: bool, inference: bool, fresh_seed: int) -> None:
    torch.manual_seed(fresh_seed)
    alpha, beta, start = (
        torch.rand(3, 1 if constant else steps, dtype=D),
        torch.randn(3, steps, dtype=D),
        torch.randn(3, dtype=D),
    )
    with torch.inference_mode(inference):
        x = scan(alpha, beta, start)
    torch.testing.assert_close(x, looped(alpha, beta, start), rtol=0, atol=1e-12)


def test_scan_of_hard_factors() -> None:
    beta = torch.ones(200, dtype=D)
    for value in (0.0, 1.0, -1.0, 1e-300):
        alpha = torch.full((200,), value, dtype=D)
        torch.testing.assert_close(scan(alpha, beta, beta[0]), looped(alpha, beta, beta[0]))


def test_scan_broadcasts() -> None:
    out = scan(torch.full((4, 1, 1), 0.5, dtype=D), torch.ones(3, 70, dtype=D), torch.zeros((), dtype=D))
    assert out.shape == (4, 3, 70)


@pytest.mark.parametrize("steps", [1, 6, 40])
@pytest.mark.parametrize("constant", [False, True])
def test_pair_is_the_loop(steps: int, constant: bool, fresh_seed: int) -> None:
    torch.manual_seed(fresh_seed)
    m = [0.6 * torch.randn(2, 1 if constant else steps, dtype=D) for _ in range(4)]
    b = [torch.randn(2, steps, dtype=D) for _ in range(2)]
    x = [torch.randn(2, dtype=D) for _ in range(2)]
    got = scan_pair((m[0], m[1], m[2], m[3]), (b[0], b[1]), (x[0], x[1]))
    m = [each.expand(2, steps) for each in m]
    for k in range(steps):
        x = [m[0][:, k] * x[0] + m[1][:, k] * x[1] + b[0][:, k], m[2][:, k] * x[0] + m[3][:, k] * x[1] + b[1][:, k]]
        torch.testing.assert_close(torch.stack([g[:, k] for g in got]), torch.stack(x), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("steps", [6, pytest.param(40, marks=pytest.mark.slow)])
@pytest.mark.parametrize("constant", [False, True])
def test_derivatives(steps: int, constant: bool) -> None:
    torch.manual_seed(0)
    rows = 1 if constant else steps
    alpha = torch.rand(2, rows, dtype=D, requires_grad=True)
    beta = torch.randn(2, steps, dtype=D, requires_grad=True)
    start = torch.randn(2, dtype=D, requires_grad=True)
    assert torch.autograd.gradcheck(scan, (alpha, beta, start))
    assert torch.autograd.gradgradcheck(scan, (alpha, beta, start))
    pair = [(0.5 * torch.randn(2, rows, dtype=D)).requires_grad_() for _ in range(4)]
    more = [torch.randn(2, steps, dtype=D, requires_grad=True) for _ in range(2)]
    first = [torch.randn(2, dtype=D, requires_grad=True) for _ in range(2)]
    assert torch.autograd.gradcheck(lambda *p: scan_pair(p[:4], p[4:6], p[6:]), (*pair, *more, *first))


def test_scan_is_fast() -> None:
    alpha, beta, start = torch.rand(64, 30000, dtype=D), torch.randn(64, 30000, dtype=D), torch.zeros(64, dtype=D)
    scan(alpha, beta, start)
    best = 10.0
    for _ in range(5):
        before = time.process_time()
        scan(alpha, beta, start)
        best = min(best, time.process_time() - before)
    assert best < 0.4  # 0.03 to 0.1 s on one core; the bar leaves room for a busy machine
