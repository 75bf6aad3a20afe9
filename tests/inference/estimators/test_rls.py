"""Recursive least squares: plain least squares, the textbook recursion, honest intervals, and where it has none."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.inference import BeliefStream, JerkForm
from avtorch.inference.estimators import RecursiveLeastSquares
from avtorch.inference.latent import LatentForm
from tests.bars import BAR

F64 = torch.float64


def taken(forgetting, *windows, seed=0):
    """The belief after some windows, all excited."""
    vehicles = len(windows[0].a)
    loop = RecursiveLeastSquares(JerkForm(), vehicles=vehicles, forgetting=forgetting, kept=4000, seed=seed)
    every = torch.arange(vehicles)
    for w in windows:
        rows = {"time": w.time, "usable": torch.ones_like(w.a, dtype=torch.bool), **w.columns}
        found, converged = loop._learn(rows, every)
        loop.belief = loop.belief.updated(torch.ones(vehicles, dtype=torch.bool), every, found, converged)
    return loop.belief


def test_forgetting_nothing_is_least_squares(make_windows, fresh_seed):
    windows = [make_windows(fresh_seed + k, [1.0, 0.5], T=[0.3, 1.2], K=[1.0, 0.6]) for k in range(3)]
    belief = taken(1.0, *windows)
    for v in range(2):
        a, u, jerk = (torch.cat([getattr(w, name)[v] for w in windows]) for name in ("a", "u", "jerk"))
        x = torch.stack([-a, u], -1)
        b, g = torch.linalg.lstsq(x, jerk).solution
        cov = (jerk - x @ torch.stack([b, g])).square().sum() / (len(jerk) - 2) * torch.linalg.inv(x.mT @ x)
        slope = torch.stack([-g / b.square(), 1 / b])
        expected = torch.stack([1 / b, g / b])
        torch.testing.assert_close(belief.mean[v, :2], expected, rtol=1e-10, atol=0)
        sd = torch.stack([cov[0, 0].sqrt() / b.square(), (slope @ cov @ slope).sqrt()])
        # the residual is a difference of sums, and keeps fewer digits
        torch.testing.assert_close(belief.sd[v, :2], sd, rtol=1e-7, atol=0)


def test_forgetting_is_the_textbook_recursion(make_windows, fresh_seed):
    factor = 0.97
    windows = [make_windows(fresh_seed + k, [1.0]) for k in range(2)]
    belief = taken(factor, *windows)
    beta, P = np.zeros(2), 1e9 * np.eye(2)
    for w in windows:
        for a, u, jerk in zip(w.a[0].numpy(), w.u[0].numpy(), w.jerk[0].numpy(), strict=True):
            x = np.array([-a, u])
            gain = P @ x / (factor + x @ P @ x)
            beta = beta + gain * (jerk - x @ beta)
            P = (P - np.outer(gain, x @ P)) / factor
    # its start is forgotten to 0.97^400 = 5e-6 of 1e-9; what is left is round-off of a covariance that began at 1e9
    assert belief.mean[0, 0].item() == pytest.approx(1 / beta[0], rel=1e-6)
    assert belief.mean[0, 1].item() == pytest.approx(beta[1] / beta[0], rel=1e-6)


def white(count, rows, T, K, sigma, seed):
    """Rows of ``count`` vehicles behind white commands."""
    a, u, noise = torch.randn(3, count, rows, generator=torch.Generator().manual_seed(seed), dtype=F64)
    jerk = (K * u - a) / T + sigma * noise
    return {"usable": torch.ones_like(a, dtype=torch.bool), "accel": a, "accel_cmd": u, "jerk": jerk}


@pytest.mark.statistical
def test_intervals_cover(rotating_seed, draws_factor):
    """Of 4000 vehicles; normal in place of Student's t (198) costs 0.0015."""
    count = 4000 * draws_factor
    loop = RecursiveLeastSquares(JerkForm(), vehicles=count, forgetting=1.0, kept=2)
    found, converged = loop._learn(white(count, 200, 0.6, 0.8, 1.0, rotating_seed), torch.arange(count))
    truth = torch.tensor([0.6, 0.8, 1.0], dtype=F64)
    assert converged.all()
    covered = ((found.q05 <= truth) & (truth <= found.q95)).double().mean(0)
    # sigma's interval is normal in its logarithm: off by a skewness of order 1/sqrt(2n) = 0.05, in the tails 0.01
    assert ((covered - 0.9).abs() < BAR * math.sqrt(0.09 / count) + torch.tensor([0.0015, 0.0015, 0.01])).all()


@pytest.mark.statistical
def test_with_forgetting_the_customary_covariance_is_twice_too_wide(rotating_seed, draws_factor):
    """White regressors: the estimate's variance is (1-f)/(1+f), what the covariance claims 1-f, of sigma^2/s^2."""
    count, factor = 2000 * draws_factor, 0.99
    loop = RecursiveLeastSquares(JerkForm(), vehicles=count, forgetting=factor, kept=2)
    found, converged = loop._learn(white(count, 1000, 0.5, 0.8, 0.3, rotating_seed), torch.arange(count))
    assert converged.all()
    ratio = (found.mean[:, 0].std() / found.sd[:, 0].mean()).item()
    # a standard deviation of n is good to 1/sqrt(2 n); the inverse of a random matrix of 100 rows adds 1 to 2 %
    assert ratio == pytest.approx(1 / math.sqrt(1 + factor), rel=BAR / math.sqrt(2 * count) + 0.03)


@pytest.mark.statistical
def test_draws_and_quantiles_agree(make_windows, rotating_seed):
    belief = taken(1.0, make_windows(rotating_seed, [0.3], T=0.6, K=0.8), seed=rotating_seed)
    for i in range(3):
        below = (belief.draws[:, 0, i] < belief.q05[0, i]).double().mean().item()
        above = (belief.draws[:, 0, i] > belief.q95[0, i]).double().mean().item()
        # 4000 draws
        assert abs(below - 0.05) < BAR * math.sqrt(0.05 * 0.95 / 4000)
        assert abs(above - 0.05) < BAR * math.sqrt(0.05 * 0.95 / 4000)


def test_a_coefficient_near_zero_gives_no_belief():
    """Jerk that has nothing to do with a and u: 1/T_L is arbitrary, so the prior stays and no number is reported."""
    g = torch.Generator().manual_seed(0)
    a, u, jerk = (torch.randn(1, 400, generator=g, dtype=F64) for _ in range(3))
    stream = BeliefStream(window=2.0, estimator="rls")
    before = stream.inference.belief
    windows = stream.feed(0.01 * torch.arange(400, dtype=F64), {"accel": a, "accel_cmd": u, "jerk": jerk})
    for window in windows + stream.flush():
        belief = window.belief
        assert belief.excited.all()
        assert not belief.converged.any()
        assert belief.draws.equal(before.draws)


def test_what_it_cannot_do_is_refused():
    with pytest.raises(InputError, match="measured jerk"):
        RecursiveLeastSquares(LatentForm(accel=True, speed=False))
    with pytest.raises(InputError, match=r"^forgetting: "):
        RecursiveLeastSquares(JerkForm(), forgetting=0.0)
