"""The price of a longer gap: throughput against stability, by the exact verdicts."""

import pytest
import torch

from avtorch.decision import Setting
from avtorch.errors import InputError
from avtorch.vehicle import stability
from benchmarks.options.trade_off import gap_trade_off


def draws(T=1.5, K=0.5, sd=0.02, n=400):
    z = torch.randn(2, n, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return T * torch.exp(sd * z[0]), K * torch.exp(0.5 * sd * z[1])


def test_longer_gaps_buy_stability_and_cost_throughput():
    T, K = draws()
    gaps = [1.0, 1.6, 2.0, 2.5]
    seen = gap_trade_off(T, K, gaps, speed=25.0)
    assert seen.throughput_vph.tolist() == pytest.approx([3600 * 25 / (25 * g + 9.5) for g in gaps])
    assert seen.cost_vph.tolist()[0] == 0.0
    assert bool((seen.throughput_vph.diff() < 0).all())
    for i, gap in enumerate(gaps):
        stable = stability.string_stable(T, K, gap, (1.5, 1.5, -0.8))
        assert float(seen.p_string_stable[i]) == float(stable.double().mean())
        peak = stability.peak_gain(T, K, gap, (1.5, 1.5, -0.8)).sort().values
        assert float(seen.peak_gain[1][i]) == float(peak[200])
    assert seen.least_gap() == 2.5
    assert gap_trade_off(T, K, [1.0, 1.6]).least_gap() is None


def test_what_else_is_set_counts():
    T, K = draws()
    inverted = gap_trade_off(T, K, [1.0], setting=Setting(T_hat=1.5, K_hat=0.5))
    assert float(inverted.p_string_stable) == 1.0
    linked = gap_trade_off(*draws(1.0, 0.8), [1.0], setting=Setting(feedforward=0.75), link_delay=0.1)
    late = gap_trade_off(*draws(1.0, 0.8), [1.0], setting=Setting(feedforward=0.75), link_delay=0.5)
    assert float(linked.p_string_stable) > 0.9 > 0.1 > float(late.p_string_stable)


def test_shapes_that_do_not_fit_are_refused():
    T, K = draws()
    with pytest.raises(InputError, match="time_gaps"):
        gap_trade_off(T[None], K[None], [1.0])
    with pytest.raises(InputError, match="time_gaps"):
        gap_trade_off(T, K, [])
    with pytest.raises(InputError, match="setting"):
        gap_trade_off(T, K, [1.0], setting=Setting(scenarios=2))
