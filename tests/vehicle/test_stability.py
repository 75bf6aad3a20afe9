"""Stability without dead time: the table of SPEC section 2, the exact conditions against brute force, the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import stability

NOMINAL = [1.5, 1.5, -0.8]
PAPER = [3.0, 3.0, -1.8]

# T, K, tau, gains, B, C/K, string stable, peak gain; the figures carry the digits that SPEC section 2 prints.
TABLE = [
    (0.3, 1.0, 1.0, NOMINAL, "1.44", "1.35", True, "1.000"),
    (1.5, 0.5, 1.0, NOMINAL, "-2.54", "-0.825", False, "2.2445"),
    (1.5, 0.5, 2.0, NOMINAL, "-4.79", "4.8", False, "1.0767"),
    (1.5, 0.5, 2.5, NOMINAL, "-5.915", "8.456", True, "1.000"),
    (1.5, 0.5, 1.0, PAPER, "-5.39", "2.1", False, "1.4789"),
    (1.33, 0.64, 2.0, NOMINAL, "-5.375", "6.984", True, "1.000"),
    (1.33, 0.64, 1.0, PAPER, "-5.583", "4.368", False, "1.1710"),
]


def half_digit(printed: str) -> float:
    """Half a unit of the last printed digit, and a hair for ties."""
    return 0.5001 * 10.0 ** -len(printed.partition(".")[2])


def random_settings(n: int, seed: int) -> tuple[torch.Tensor, ...]:
    """Wide, partly unstable settings: T, K, tau and gains, with k_a of either sign and some k_v of zero."""
    rng = torch.Generator().manual_seed(seed)
    T, K, tau, ks, kv, ka, zero = torch.rand(7, n, generator=rng, dtype=torch.float64)
    kv = torch.where(zero < 0.05, torch.zeros_like(kv), 4 * kv - 0.4)
    return 0.02 + 2 * T, 0.1 + 1.4 * K, 0.2 + 2.8 * tau, torch.stack((4 * ks - 0.2, kv, 3.5 * ka - 2.5), -1)


def string_margin(T, K, tau, gains, **feedforward):
    """The least of T² x² + B x + C over x = omega² >= 0: the gain condition holds where it is not below zero."""
    B, C = stability.string_margins(T, K, tau, gains, **feedforward)
    return C - B.clamp_max(0) ** 2 / (4 * T**2)


def direct_gain(omega, T, K, tau, gains, theta=0.0):
    """|G(j omega)| from the state equations of (spacing error, speed difference, a), not from the closed form."""
    ks, kv, ka = gains.unbind(-1)
    s = 1j * omega
    # x_lead = 1: spacing error e = 1 - X (1 + tau s), speed difference s (1 - X); solve (T s + 1) s^2 X = K E u for X.
    feed = K * torch.exp(-s * theta)
    return ((feed * (ks + kv * s)) / ((T * s + 1) * s**2 + feed * (ks * (1 + tau * s) + kv * s - ka * s**2))).abs()


@pytest.mark.parametrize("row", TABLE)
def test_table_of_spec_section_2(row):
    T, K, tau, gains, B, C_over_K, string, peak = row
    got_B, got_C = stability.string_margins(T, K, tau, gains)
    assert got_B.item() == pytest.approx(float(B), abs=half_digit(B))
    assert (got_C / K).item() == pytest.approx(float(C_over_K), abs=half_digit(C_over_K))
    assert stability.local_stable(T, K, tau, gains).item()
    assert stability.string_stable(T, K, tau, gains).item() is string
    assert stability.peak_gain(T, K, tau, gains).item() == pytest.approx(float(peak), abs=half_digit(peak))
    assert (string_margin(T, K, tau, gains).item() >= 0) is string
    # Eq. 3 asks for both B > 0 and C > 0, so of this table it passes the nominal setting alone.
    assert stability.string_sufficient(T, K, tau, gains).item() is (float(B) > 0 and float(C_over_K) > 0)


def test_table_at_once_by_broadcasting():
    T, K, tau = (torch.tensor([row[i] for row in TABLE]) for i in range(3))
    gains = torch.tensor([row[3] for row in TABLE])
    assert stability.string_stable(T, K, tau, gains).tolist() == [row[6] for row in TABLE]
    assert stability.peak_gain(T, K, tau[:, None], gains).shape == (7, 7)
    assert stability.peak_gain(T, K, 1.0, NOMINAL).shape == (7,)
    assert stability.local_stable(0.3, 1, 1, NOMINAL).shape == ()
    assert stability.peak_gain(T.float(), K.float(), 1.0, NOMINAL).dtype == torch.float32
    assert stability.peak_gain(1, 1, 1, NOMINAL).dtype == torch.float64


def test_local_stability_is_where_the_cubic_has_its_roots(fresh_seed):
    T, K, tau, gains = random_settings(30_000, fresh_seed)
    ks, kv, ka = gains.unbind(-1)
    rows = torch.stack(((1 - K * ka) / T, K * (ks * tau + kv) / T, K * ks / T), -1)
    companion = torch.zeros(T.numel(), 3, 3, dtype=torch.float64)
    companion[:, 0] = -rows
    companion[:, 1, 0] = companion[:, 2, 1] = 1
    rightmost = np.linalg.eigvals(companion.numpy()).real.max(-1)
    # Roots this near the axis are within the eigenvalue solver's own error.
    clear = torch.from_numpy(np.abs(rightmost) > 1e-7)
    got = stability.local_stable(T, K, tau, gains)
    assert 0.2 < got.double().mean() < 0.9
    assert torch.equal(got[clear], torch.from_numpy(rightmost < 0)[clear])


@pytest.mark.slow
def test_exact_string_condition_and_peak_against_a_sweep(fresh_seed):
    T, K, tau, gains = random_settings(20_000, fresh_seed)
    local = stability.local_stable(T, K, tau, gains)
    string = stability.string_stable(T, K, tau, gains)
    peak = stability.peak_gain(T, K, tau, gains)
    at = stability.peak_frequency(T, K, tau, gains)
    swept = torch.zeros_like(T)
    for omega in torch.logspace(-3, 2.5, 1200, dtype=torch.float64).split(60):
        columns = (x.unsqueeze(-1) for x in (T, K, tau))
        swept = torch.maximum(swept, direct_gain(omega, *columns, gains.unsqueeze(-2)).amax(-1))
    assert not peak.isnan().any()
    assert torch.equal(peak.isinf(), ~local)
    assert 0.05 < string.double().mean() < 0.7
    # No frequency of the sweep lies above the peak, and the peak is a value that |G| does take: so it is the supremum.
    # Rounding: |G| is a quotient of sums of some ten terms that cancel by at most the gain itself.
    slack = 1e-13 * (1 + peak[local])
    assert (swept[local] <= peak[local] * (1 + slack)).all()
    taken = direct_gain(at, T, K, tau, gains)[local & (at > 0)]
    assert torch.allclose(taken, peak[local & (at > 0)], rtol=1e-10, atol=0)
    assert (peak[string] == 1).all()
    assert (at[string] == 0).all()
    # Beyond string stability a gain above one exists; how far above is C^2, so it may round to one near the boundary.
    _, C = stability.string_margins(T, K, tau, gains)
    amplifies = local & ~string & (C.abs() > 1e-3)
    assert (peak[amplifies] > 1).all()
    # The gain condition alone would pass locally unstable loops.
    assert ((string_margin(T, K, tau, gains) >= 0) & ~local).any()


def test_eq3_is_sufficient_and_not_necessary(fresh_seed):
    T, K, tau, gains = random_settings(20_000, fresh_seed)
    sufficient = stability.string_sufficient(T, K, tau, gains)
    exact = stability.string_stable(T, K, tau, gains)
    assert sufficient.any()
    assert not (sufficient & ~exact).any()
    assert (exact & ~sufficient).any()


def test_boundary_of_string_stability_counts_as_stable():
    # C = 0 on paper: K = 1, k_s = 1, k_v = 0, k_a = 0 gives C = tau^2 - 2.
    tau = torch.tensor(2.0, dtype=torch.float64).sqrt()
    assert stability.string_stable(0.1, 1.0, tau, [1.0, 0.0, 0.0]).item()
    assert not stability.string_stable(0.1, 1.0, tau - 1e-9, [1.0, 0.0, 0.0]).item()
    assert stability.string_stable(0.1, 1.0, tau + 1e-9, [1.0, 0.0, 0.0]).item()


def test_boundary_of_local_stability_is_not_stable():
    # (1/K - k_a) g = (T/K) k_s with exact numbers: T = g / k_s = 2.
    assert not stability.local_stable(2.0, 1.0, 1.0, [1.0, 1.0, 0.0]).item()
    assert stability.local_stable(2.0 - 1e-12, 1.0, 1.0, [1.0, 1.0, 0.0]).item()
    assert stability.peak_gain(2.0, 1.0, 1.0, [1.0, 1.0, 0.0]).item() == math.inf
    # Just inside, the loop rings at sqrt(K k_s / (1 - K k_a)) as hard as one likes.
    assert stability.peak_gain(2.0 - 1e-6, 1.0, 1.0, [1.0, 1.0, 0.0]).item() > 1e5
    assert stability.peak_frequency(2.0 - 1e-6, 1.0, 1.0, [1.0, 1.0, 0.0]).item() == pytest.approx(1.0, rel=1e-5)


NO_ACTUATOR = [(-0.3, 1.0), (-1.0, -1.0), (math.inf, math.inf), (math.inf, 1.0), (-math.inf, -math.inf)]
NO_ACTUATOR += [(math.nan, 1.0), (0.3, 0.0), (0.3, -1.0), (0.3, math.nan)]


@pytest.mark.parametrize("dead_time", [0.0, 0.2])
def test_what_is_no_actuator_is_unstable_and_never_nan(dead_time):
    T, K = (
        torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in zip(*NO_ACTUATOR, (0.3, 1.0), strict=True)
    )
    there = [False] * len(NO_ACTUATOR) + [True]
    assert stability.local_stable(T, K, 1.0, NOMINAL, dead_time=dead_time).tolist() == there
    assert stability.string_stable(T, K, 1.0, NOMINAL, dead_time=dead_time).tolist() == there
    peak = stability.peak_gain(T, K, 1.0, NOMINAL, dead_time=dead_time)
    assert peak.tolist() == [1.0 if x else math.inf for x in there]
    assert stability.peak_frequency(T, K, 1.0, NOMINAL, dead_time=dead_time).isfinite().all()
    assert stability.gain(1.0, T, K, 1.0, NOMINAL, dead_time=dead_time).isfinite().all()
    assert (stability.dead_time_margin(T, K, 1.0, NOMINAL)[:-1] == 0).all()
    assert not any(x.isnan().any() for x in stability.string_margins(T, K, 1.0, NOMINAL))
    assert not stability.local_conditions(T, K, 1.0, NOMINAL).holds[:-1].any()
    assert not stability.string_sufficient(T, K, 1.0, NOMINAL)[:-1].any()
    gradient = torch.autograd.grad(peak[-1], (T, K), allow_unused=True)
    assert all(g is None or g.isfinite().all() for g in gradient)


def test_ideal_actuator_is_the_limit_from_above():
    tau = torch.linspace(0.3, 3, 40, dtype=torch.float64)
    for gains in (NOMINAL, PAPER, [1.0, 0.0, 0.0], [0.7, 0.1, 0.3]):
        exact, near = (stability.peak_gain(T, 1.0, tau, gains) for T in (0.0, 1e-12))
        assert torch.allclose(exact, near, rtol=1e-9)
        assert torch.equal(*(stability.string_stable(T, 1.0, tau, gains) for T in (0.0, 1e-12)))


def test_tiny_and_huge_gains_do_not_overflow():
    scale = torch.logspace(-6, 6, 49, dtype=torch.float64)
    gains = torch.stack((scale, scale.sqrt(), -scale), -1)
    peak = stability.peak_gain(0.3, 1.0, torch.tensor([[0.1], [1.0]], dtype=torch.float64), gains)
    assert not peak.isnan().any()
    assert (peak >= 1).all()


@pytest.mark.parametrize("dead_time", [0.0, 0.4])
def test_float32_and_empty_batches(dead_time):
    T = torch.tensor([0.3, 1.5, 1.5])
    K, tau = torch.tensor([1.0, 0.5, 0.5]), torch.tensor([1.0, 1.0, 2.5])
    single = stability.peak_gain(T, K, tau, NOMINAL, dead_time=dead_time)
    double = stability.peak_gain(T.double(), K.double(), tau.double(), NOMINAL, dead_time=dead_time)
    assert single.dtype == torch.float32
    assert torch.allclose(single.double(), double, rtol=1e-5)
    verdicts = (
        stability.string_stable(x, y, z, NOMINAL, dead_time=dead_time).tolist()
        for x, y, z in ((T, K, tau), (T.double(), K.double(), tau.double()))
    )
    assert next(verdicts) == next(verdicts)
    none = torch.zeros(0, 2, dtype=torch.float64)
    for function in (stability.local_stable, stability.string_stable, stability.peak_gain, stability.peak_frequency):
        assert function(none, 1.0, 1.0, NOMINAL, dead_time=dead_time).shape == (0, 2)


@pytest.mark.parametrize("dead_time", [0.0, 0.4])
def test_gradient_of_the_peak_gain(dead_time):
    T, K, tau = (torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (0.3, 1.0, 1.0))
    T, K = (T, K) if dead_time else (T.detach().mul(5).requires_grad_(), K.detach().mul(0.5).requires_grad_())
    gains = torch.tensor(NOMINAL, dtype=torch.float64, requires_grad=True)
    theta = torch.tensor(dead_time, dtype=torch.float64, requires_grad=bool(dead_time))

    def peak(T, K, tau, gains, theta):
        return stability.peak_gain(T, K, tau, gains, dead_time=theta)

    assert torch.autograd.gradcheck(peak, (T, K, tau, gains, theta), eps=1e-5, atol=1e-7, rtol=1e-5)


def test_feedforward_without_delay_agrees_with_its_sweep(fresh_seed):
    T, K, tau, gains = random_settings(2000, fresh_seed)
    kf = torch.linspace(0, 1.5, 2000, dtype=torch.float64)
    closed = stability.string_stable(T, K, tau, gains, feedforward=kf)
    peak = stability.peak_gain(T, K, tau, gains, feedforward=kf)
    margin = string_margin(T, K, tau, gains, feedforward=kf)
    clear = margin.abs() > 1e-4
    assert torch.equal(closed[clear], (peak == 1)[clear])
    # A small delay of the message changes little, and goes through the sweep.
    late = stability.string_stable(T, K, tau, gains, feedforward=kf, feedforward_delay=1e-9)
    assert torch.equal(closed[clear], late[clear])
    # Feeding the leader's acceleration forward calms the degraded vehicle.
    calmer = stability.peak_gain(1.5, 0.5, 1.0, NOMINAL, feedforward=0.8)
    assert calmer < stability.peak_gain(1.5, 0.5, 1.0, NOMINAL)


@pytest.mark.parametrize(
    ("arguments", "keywords", "says"),
    [
        ((0.3, 1.0, 1.0, [1.5, 1.5]), {}, "gains"),
        ((0.3, 1.0, 1.0, 1.5), {}, "gains"),
        ((0.3, 1.0, 1.0, "abc"), {}, "gains"),
        ((0.3, 1.0, 1.0, NOMINAL), {"dead_time": -0.1}, "dead_time"),
        ((0.3, 1.0, 1.0, NOMINAL), {"dead_time": math.nan}, "dead_time"),
        ((0.3, 1.0, 1.0, NOMINAL), {"dead_time": math.inf}, "dead_time"),
        ((torch.ones(3), torch.ones(2), 1.0, NOMINAL), {}, "broadcast"),
        (("fast", 1.0, 1.0, NOMINAL), {}, "T_L"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, keywords, says):
    for function in (stability.local_stable, stability.string_stable, stability.peak_gain):
        with pytest.raises(InputError, match=says) as caught:
            function(*arguments, **keywords)
        assert "\n" not in str(caught.value)
