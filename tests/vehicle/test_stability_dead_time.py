"""Dead time: the reference values of SPEC section 2, the Nyquist count against roots, the sweep against a finer one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avtorch.vehicle import stability
from avtorch.vehicle.stability.linear_loop import linear_loop
from avtorch.vehicle.stability.nyquist import nyquist
from avtorch.vehicle.stability.sweep import exceeds_anywhere, sweep

NOMINAL = [1.5, 1.5, -0.8]


def random_delayed(n: int, seed: int) -> tuple[torch.Tensor, ...]:
    rng = torch.Generator().manual_seed(seed)
    T, K, tau, ks, kv, ka, theta = torch.rand(7, n, generator=rng, dtype=torch.float64)
    gains = torch.stack((0.05 + 3 * ks, 3 * kv, 3 * ka - 2), -1)
    return 0.05 + 1.5 * T, 0.2 + K, 0.3 + 2.5 * tau, gains, 1.2 * theta**2


def state_space(T, K, tau, gains):
    """x' = A x(t) + D x(t - theta) + b a_lead, x = (spacing error, speed difference, a); u acts a dead time late."""
    A = np.array([[0, 1, -tau], [0, 0, -1], [0, 0, -1 / T]])
    D = np.zeros((3, 3))
    D[2] = K / T * np.asarray(gains)
    return A, D


def rightmost_root(T, K, tau, gains, theta, nodes=24):
    """Largest real part of the delayed loop's roots: Chebyshev collocation of the delay's shift operator."""
    A, D = state_space(T, K, tau, gains)
    k = np.arange(nodes + 1)
    t = np.cos(np.pi * k / nodes)
    c = np.where((k == 0) | (k == nodes), 2.0, 1.0) * (-1.0) ** k
    gap = t[:, None] - t[None, :] + np.eye(nodes + 1)
    diff = np.outer(c, 1 / c) / gap
    diff -= np.diag(diff.sum(1))
    shift = np.kron(diff * 2 / theta, np.eye(3))
    # The first block row is the present; the last column block the state a dead time ago.
    shift[:3] = 0
    shift[:3, :3], shift[:3, -3:] = A, D
    return np.linalg.eigvals(shift).real.max()


def test_reference_values():
    theta = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64)
    peak = stability.peak_gain(0.3, 1.0, 1.0, NOMINAL, dead_time=theta)
    string = stability.string_stable(0.3, 1.0, 1.0, NOMINAL, dead_time=theta)
    local = stability.local_stable(0.3, 1.0, 1.0, NOMINAL, dead_time=theta)
    assert peak[4].item() == pytest.approx(1.7464, abs=5e-5)
    at = stability.peak_frequency(0.3, 1.0, 1.0, NOMINAL, dead_time=0.4)
    assert at.item() == pytest.approx(3.02, abs=5e-3)
    assert stability.gain(at, 0.3, 1.0, 1.0, NOMINAL, dead_time=0.4).item() == pytest.approx(peak[4].item(), rel=1e-12)
    # Lumping the delay into T_L says "string stable" up to 0.7; that agrees with the delayed loop up to 0.3 only.
    lumped = stability.string_stable(0.3 + theta[:5], 1.0, 1.0, NOMINAL)
    assert lumped.tolist() == [True] * 5
    assert string.tolist() == [True] * 4 + [False] * 3
    assert local.tolist() == [True] * 6 + [False]
    assert peak[:4].tolist() == [1.0] * 4
    assert peak[6].item() == math.inf
    # The boundary itself, between the two figures.
    margin = stability.dead_time_margin(0.3, 1.0, 1.0, NOMINAL).item()
    assert 0.5 < margin < 0.6
    assert (
        rightmost_root(0.3, 1.0, 1.0, NOMINAL, margin - 1e-4)
        < 0
        < rightmost_root(0.3, 1.0, 1.0, NOMINAL, margin + 1e-4)
    )


def test_nyquist_count_against_the_roots(fresh_seed):
    T, K, tau, gains, theta = random_delayed(600, fresh_seed)
    theta = theta.clamp_min(0.01)
    # some that only a delay could unsettle or settle: without it k_a > 1/K makes them unstable
    gains[:100, 2] += 1.5
    got = stability.local_stable(T, K, tau, gains, dead_time=theta)
    rows = zip(T.tolist(), K.tolist(), tau.tolist(), gains.tolist(), theta.tolist(), strict=True)
    roots = torch.tensor([rightmost_root(*row) for row in rows])
    clear = roots.abs() > 1e-6
    assert 100 < got.sum() < 500
    assert torch.equal(got[clear], (roots < 0)[clear])


def test_peak_gain_against_a_finer_sweep(fresh_seed):
    T, K, tau, gains, theta = random_delayed(2000, fresh_seed)
    peak = stability.peak_gain(T, K, tau, gains, dead_time=theta)
    at = stability.peak_frequency(T, K, tau, gains, dead_time=theta)
    string = stability.string_stable(T, K, tau, gains, dead_time=theta)
    local = stability.local_stable(T, K, tau, gains, dead_time=theta)
    assert torch.equal(peak.isinf(), ~local)
    swept = torch.zeros_like(T)
    columns = [x.unsqueeze(-1) for x in (T, K, tau)]
    for w in torch.logspace(-3, 2.3, 4000, dtype=torch.float64).split(200):
        size = stability.gain(w, *columns, gains.unsqueeze(-2), dead_time=theta.unsqueeze(-1))
        swept = torch.maximum(swept, size.amax(-1))
    # The refinement ends within 1e-8 of its bracket, and a maximum is flat.
    assert (swept[local] <= peak[local] * (1 + 1e-10)).all()
    taken = stability.gain(at, T, K, tau, gains, dead_time=theta)
    assert torch.allclose(taken[local & (at > 0)], peak[local & (at > 0)], rtol=1e-12)
    assert 0.1 < string.double().mean() < 0.9
    assert (peak[string] == 1).all()
    assert (swept[string] <= 1 + 1e-12).all()
    assert (peak[local & ~string] >= 1).all()
    # What amplifies too little for its peak to differ from one has a C that is barely negative.
    missed = local & ~string & (peak <= 1)
    _, C = stability.string_margins(T, K, tau, gains)
    assert (C[missed].abs() < 1e-3).all()


def test_verdict_on_few_points_is_that_of_the_full_sweep(fresh_seed):
    T, K, tau, gains, theta = random_delayed(6000, fresh_seed)
    kf = torch.linspace(-1, 1, 6000, dtype=torch.float64).clamp_min(0)
    setting = linear_loop(T, K, tau, gains, dead_time=theta, feedforward=kf, feedforward_delay=theta / 2)
    setting = setting.pick(setting.full(nyquist(setting)))
    above = sweep(setting)[1]
    assert 0.1 < above.double().mean() < 0.99
    assert torch.equal(exceeds_anywhere(setting), above)


def test_a_vanishing_dead_time_changes_nothing(fresh_seed):
    T, K, tau, gains, _ = random_delayed(3000, fresh_seed)
    plain, tiny = (
        (f(T, K, tau, gains), f(T, K, tau, gains, dead_time=1e-10))
        for f in (stability.peak_gain, stability.string_stable)
    )
    B, C = stability.string_margins(T, K, tau, gains)
    margin = C - B.clamp_max(0) ** 2 / (4 * T**2)
    assert torch.equal(plain[0].isinf(), plain[1].isinf())
    calm = (plain[0] < 1e3) & (plain[0].isfinite())
    assert torch.allclose(plain[0][calm], plain[1][calm], rtol=1e-5)
    clear = margin.abs() > 1e-6
    assert torch.equal(tiny[0][clear], tiny[1][clear])


def test_zero_and_nonzero_dead_times_mix():
    theta = torch.tensor([0.0, 0.4, 0.0, 0.7], dtype=torch.float64)
    T, K = torch.tensor([[0.3], [1.5]], dtype=torch.float64), torch.tensor([[1.0], [0.5]], dtype=torch.float64)
    for function in (stability.local_stable, stability.string_stable, stability.peak_gain, stability.peak_frequency):
        together = function(T, K, 1.0, NOMINAL, dead_time=theta)
        assert together.shape == (2, 4)
        for i in range(2):
            for j in range(4):
                alone = function(T[i, 0], K[i, 0], 1.0, NOMINAL, dead_time=theta[j])
                assert together[i, j].item() == pytest.approx(alone.item(), rel=1e-12)


def test_dead_time_margin_is_where_the_verdict_turns(fresh_seed):
    T, K, tau, gains, _ = random_delayed(5000, fresh_seed)
    margin = stability.dead_time_margin(T, K, tau, gains)
    local = stability.local_stable(T, K, tau, gains)
    assert torch.equal(margin > 0, local)
    below, above = margin[local] * (1 - 1e-9), margin[local] * (1 + 1e-9)
    pick = (T[local], K[local], tau[local], gains[local])
    assert stability.local_stable(*pick, dead_time=below).all()
    assert not stability.local_stable(*pick, dead_time=above).any()


def test_without_lag_a_delayed_strong_acceleration_gain_never_settles():
    # A = K E u with |K k_a| > 1 echoes: each delay multiplies the acceleration by more than one.
    assert stability.local_stable(0.0, 1.0, 1.0, [1.5, 1.5, -1.2]).item()
    assert not stability.local_stable(0.0, 1.0, 1.0, [1.5, 1.5, -1.2], dead_time=1e-3).item()
    assert stability.local_stable(0.0, 1.0, 1.0, [1.5, 1.5, -0.8], dead_time=1e-3).item()
    assert stability.dead_time_margin(0.0, 1.0, 1.0, [1.5, 1.5, -1.2]).item() == 0
    # With a lag as small as one likes the same happens at a dead time of its size.
    assert not stability.local_stable(1e-6, 1.0, 1.0, [1.5, 1.5, -1.2], dead_time=1e-3).item()


def test_gain_from_the_state_equations():
    T, K, tau, theta = 0.4, 0.8, 1.2, 0.3
    A, D = state_space(T, K, tau, NOMINAL)
    for omega in (0.1, 1.0, 3.0, 9.0):
        s = 1j * omega
        drive = np.array([0, 1, 0])
        x = np.linalg.solve(s * np.eye(3) - A - D * np.exp(-s * theta), drive)
        # drive is the leader's acceleration and x[2] the follower's: their ratio is the ratio of speeds.
        got = stability.gain(omega, T, K, tau, NOMINAL, dead_time=theta).item()
        assert abs(got - abs(x[2])) < 1e-13
    assert stability.gain(0.0, T, K, tau, NOMINAL, dead_time=theta).item() == 1.0


def test_a_resonance_too_sharp_for_any_grid_is_found():
    margin = stability.dead_time_margin(0.3, 1.0, 1.0, NOMINAL)
    # |G| grows as 1 / distance: a tenth of the distance, ten times the peak, at the same frequency.
    distance = torch.tensor([1e-3, 1e-4, 1e-5, 1e-6], dtype=torch.float64)
    near = stability.peak_gain(0.3, 1.0, 1.0, NOMINAL, dead_time=margin - distance)
    assert (near[1:] / near[:-1]).tolist() == pytest.approx([10.0] * 3, rel=2e-2)
