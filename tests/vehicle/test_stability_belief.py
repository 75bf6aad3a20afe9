"""Stability under a belief, and over a plane."""

from __future__ import annotations

import math

import pytest
import torch

from avtorch.errors import InputError
from avtorch.vehicle import stability
from avtorch.vehicle.stability import belief

NOMINAL = [1.5, 1.5, -0.8]


@pytest.fixture
def draws(fresh_seed):
    rng = torch.Generator().manual_seed(fresh_seed)
    z = torch.randn(2, 400, generator=rng, dtype=torch.float64)
    return 1.5 * torch.exp(0.2 * z[0]), 0.55 * torch.exp(0.15 * z[1])


@pytest.mark.parametrize("dead_time", [0.0, 0.15])
def test_probabilities_are_shares_of_the_draws(draws, dead_time):
    T, K = draws
    gaps = torch.tensor([1.0, 1.6, 2.5], dtype=torch.float64)
    gains = torch.tensor([NOMINAL, [3.0, 3.0, -1.8], [1.0, 2.0, -0.2]], dtype=torch.float64)
    local, string = stability.p_locally_and_string_stable(T, K, gaps[:, None], gains, dead_time=dead_time)
    assert torch.equal(string, stability.p_string_stable(T, K, gaps[:, None], gains, dead_time=dead_time))
    assert local.shape == string.shape == (3, 3)
    for i in range(3):
        for j in range(3):
            one = stability.local_stable(T, K, gaps[i], gains[j], dead_time=dead_time).double().mean()
            two = stability.string_stable(T, K, gaps[i], gains[j], dead_time=dead_time).double().mean()
            assert local[i, j].item() == pytest.approx(one.item(), abs=1e-12)
            assert string[i, j].item() == pytest.approx(two.item(), abs=1e-12)
    assert (string <= local).all()
    assert string.min() < 0.05
    assert string.max() > 0.02
    assert string.unique().numel() > 3


def test_blocks_do_not_change_the_answer(draws, monkeypatch):
    T, K = draws
    gaps = torch.linspace(0.5, 3, 37, dtype=torch.float64)
    whole = stability.stability_belief(T, K, gaps, NOMINAL)
    monkeypatch.setattr(belief, "BLOCK", 5 * 400)
    pieces = stability.stability_belief(T, K, gaps, NOMINAL)
    assert torch.equal(whole.p_string_stable, pieces.p_string_stable)
    assert torch.equal(whole.margins["peak_gain"].q95, pieces.margins["peak_gain"].q95)


def test_a_setting_that_changes_the_vehicle_has_its_own_draws(draws):
    T, K = draws
    # Effective parameters of two lower levels; the second one's inversion fails for part of the belief.
    T_e = torch.stack((T / 4, 1 / (1 / T - 0.7)))
    T_e[1, 0] = math.inf
    K_e = torch.stack((torch.ones_like(K), K))
    got = stability.p_string_stable(T_e, K_e, 1.0, NOMINAL)
    assert got.shape == (2,)
    assert not got.isnan().any()
    assert got[0] > 0.5 > got[1]
    state = stability.stability_belief(T_e, K_e, torch.tensor([1.0, 1.0], dtype=torch.float64), NOMINAL)
    assert torch.equal(state.p_string_stable, got)
    for interval in state.margins.values():
        for quantile in interval:
            assert not quantile.isnan().any()
    assert state.margins["peak_gain"].q95[1] == math.inf
    assert state.margins["local"].q05[1] == -math.inf


def test_margins_carry_order_statistics(draws):
    T, K = draws
    state = stability.stability_belief(T, K, 2.0, NOMINAL, dead_time=0.1)
    assert state.p_string_stable.shape == ()
    B, C = stability.string_margins(T, K, 2.0, NOMINAL)
    peak = stability.peak_gain(T, K, 2.0, NOMINAL, dead_time=0.1)
    late = stability.dead_time_margin(T, K, 2.0, NOMINAL) - 0.1
    for name, values in {"B": B, "C_over_K": C / K, "peak_gain": peak, "dead_time": late}.items():
        low, middle, high = state.margins[name]
        assert low <= middle <= high
        # Twenty of four hundred draws lie below the 5 % point, as many at or above the 95 % point.
        assert (values < low).sum() <= 20
        assert (values >= high).sum() >= 20
    assert set(state.margins) == {"local", "B", "C_over_K", "dead_time", "peak_gain"}
    assert 0 < state.error < 0.03


def test_known_numbers_are_draws_that_never_vary():
    gaps = torch.tensor([1.0, 2.5], dtype=torch.float64)
    assert stability.p_string_stable(1.5, 0.5, gaps, NOMINAL).tolist() == [0.0, 1.0]
    late = torch.tensor([0.4, 0.6])
    assert stability.p_locally_and_string_stable(0.3, 1.0, 1.0, NOMINAL, dead_time=late)[0].item() == 0.5
    with pytest.raises(InputError, match="draw"):
        stability.p_string_stable(torch.zeros(0), torch.zeros(0), 1.0, NOMINAL)
    with pytest.raises(InputError, match="gains"):
        stability.p_string_stable(1.0, 1.0, 1.0, [1.0, 2.0])


def test_region_puts_x_along_the_columns():
    ks, tau = torch.linspace(0.1, 3, 8, dtype=torch.float64), torch.linspace(0.5, 3, 5, dtype=torch.float64)
    plane = stability.region(("k_s", ks), ("tau", tau), T_L=1.5, K_L=0.5, dead_time=0.1)
    assert plane.local.shape == plane.string.shape == plane.peak_gain.shape == (5, 8)
    for row, column in ((0, 7), (4, 2), (2, 2)):
        gains = [ks[column].item(), 1.5, -0.8]
        peak = stability.peak_gain(1.5, 0.5, tau[row], gains, dead_time=0.1)
        assert plane.peak_gain[row, column].item() == pytest.approx(peak.item(), rel=1e-12)
        assert plane.string[row, column] == stability.string_stable(1.5, 0.5, tau[row], gains, dead_time=0.1)


@pytest.mark.parametrize(
    "axes", [("k_s", "k_v"), ("k_a", "k_s"), ("T", "K"), ("tau", "T"), ("K", "k_a"), ("k_v", "tau")]
)
def test_region_over_any_two(axes):
    values = [0.2, 0.4, 0.6, 0.8]
    plane = stability.region((axes[0], values), (axes[1], values[:3]))
    assert plane.string.shape == (3, 4)
    assert torch.equal(plane.string & plane.local, plane.string)
    assert torch.equal(plane.peak_gain.isfinite(), plane.local)


@pytest.mark.parametrize("form", ["print", "rigorous"])
def test_paper_regions_shrink_with_lag_and_grow_with_the_gap(form):
    plane = (("k_s", torch.linspace(0.05, 3, 40)), ("k_v", torch.linspace(0, 3, 40)))
    short, long = (stability.region(*plane, T_L=(0.0, T), form=form) for T in (0.1, 1.0))
    assert long.string_share < short.string_share
    assert long.local.sum() <= short.local.sum()
    assert not (long.string & ~short.string).any()
    # The first line of Eq. 3 tightens with the gap and the last one relaxes, so the lag is kept small here.
    near, far = (stability.region(*plane, T_L=(0.0, 0.1), time_gap=tau, form=form) for tau in (0.5, 2.0))
    assert near.string_share < far.string_share
    assert near.local.sum() <= far.local.sum()


def test_exact_region_grows_with_the_gap():
    plane = (("k_s", torch.linspace(0.05, 3, 40)), ("k_v", torch.linspace(0, 3, 40)))
    shares = [stability.region(*plane, T_L=0.4, time_gap=tau).string_share for tau in (0.5, 1.0, 2.0)]
    assert shares == sorted(shares)
    assert shares[0] < shares[2]


@pytest.mark.parametrize(
    ("x", "y", "keywords", "says"),
    [
        (("k_x", [1.0]), ("k_v", [1.0]), {}, "k_x"),
        (("k_s", [1.0]), ("k_s", [1.0]), {}, "different"),
        (("k_s", []), ("k_v", [1.0]), {}, "k_s"),
        (("k_s", [math.nan]), ("k_v", [1.0]), {}, "finite"),
        (("k_s", [1.0]), ("k_v", [1.0]), {"T_L": (0.1, 0.2)}, "bounds"),
        (("k_s", [1.0]), ("k_v", [1.0]), {"form": "print", "dead_time": 0.1}, "dead_time"),
        (("k_s", [1.0]), ("k_v", [1.0]), {"form": "exactly"}, "form"),
        (("k_s", [1.0]), ("k_v", [1.0]), {"gains": [1.0]}, "gains"),
        (("k_s", [1.0]), ("k_v", [1.0]), {"time_gap": (1.0, 2.0)}, "time_gap"),
    ],
)
def test_bad_regions_are_refused(x, y, keywords, says):
    with pytest.raises(InputError, match=says):
        stability.region(x, y, **keywords)
