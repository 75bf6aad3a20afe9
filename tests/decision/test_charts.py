"""Control charts: limits are what the stated run length demands, by simulation and by closed form."""

import math

import pytest
import torch

from avtorch.decision.charts import ALLOWANCE, CHARTS, WEIGHT, Chart, chart_limit, cusum_arl, ewma_arl, shewhart_arl
from avtorch.errors import InputError
from tests.bars import BAR


def run_lengths(kind, *, arl, components, shift, runs, seed, longest=6000):
    """First alarm of each of `runs` scenarios, (run,); innovations N(shift, 1)."""
    generator = torch.Generator().manual_seed(seed)
    chart = Chart(kind, runs, arl, components)
    first = torch.zeros(runs)
    alive = torch.ones(runs, dtype=torch.bool)
    for step in range(1, longest):
        z = torch.randn(runs, components, generator=generator, dtype=torch.float64) + shift
        alarm = chart.step(z, alive)
        first = torch.where(alive & alarm, float(step), first)
        alive &= ~alarm
        if not bool(alive.any()):
            return first
    raise AssertionError("a chart never alarmed")


def bar_of(lengths):
    return BAR * float(lengths.std()) / math.sqrt(len(lengths))


@pytest.mark.statistical
@pytest.mark.parametrize("kind", CHARTS)
def test_in_control_run_length_is_what_was_asked(kind, rotating_seed, draws_factor):
    lengths = run_lengths(kind, arl=60.0, components=1, shift=0.0, runs=4000 * draws_factor, seed=rotating_seed)
    assert abs(float(lengths.mean()) - 60.0) < bar_of(lengths)


@pytest.mark.statistical
def test_two_components_alarm_once_per_arl(rotating_seed, draws_factor):
    lengths = run_lengths("shewhart", arl=60.0, components=2, shift=0.0, runs=4000 * draws_factor, seed=rotating_seed)
    exact = 1.0 / (1.0 - (1.0 - 1.0 / 120.0) ** 2)  # either of two independent charts of 120
    assert 60.0 < exact < 61.0
    assert abs(float(lengths.mean()) - exact) < bar_of(lengths)


def test_shewhart_is_exact_and_ewma_of_weight_one_is_shewhart():
    limit = chart_limit("shewhart", 370.0)
    assert math.erfc(limit / math.sqrt(2.0)) == pytest.approx(1.0 / 370.0, rel=1e-12)
    assert shewhart_arl(limit) == pytest.approx(370.0, rel=1e-12)
    # by the quadrature of any weight, which is exact here but for the rounding of its sums
    assert ewma_arl(limit, 1.0) == pytest.approx(370.0, rel=1e-9)
    assert ewma_arl(limit, 0.999) == pytest.approx(370.0, rel=0.01)


def test_limits_solve_their_own_equation():
    assert ewma_arl(chart_limit("ewma", 500.0), WEIGHT) == pytest.approx(500.0, rel=1e-6)
    assert cusum_arl(chart_limit("cusum", 500.0), ALLOWANCE) == pytest.approx(500.0, rel=1e-6)


def test_a_cusum_of_no_height_is_two_one_sided_shewhart_arms():
    # With a limit near zero an arm alarms as soon as z exceeds the allowance: ARL 1 / (2 P(z > 1.5)).
    assert cusum_arl(1e-9, 1.5) == pytest.approx(1.0 / math.erfc(1.5 / math.sqrt(2.0)), rel=1e-6)


@pytest.mark.statistical
def test_small_shifts_are_found_sooner_by_the_charts_that_remember(rotating_seed, draws_factor):
    mean = {
        kind: run_lengths(kind, arl=300.0, components=1, shift=1.0, runs=1500 * draws_factor, seed=rotating_seed)
        for kind in CHARTS
    }
    for kind in ("ewma", "cusum"):
        gap = bar_of(mean[kind]) + bar_of(mean["shewhart"])
        assert float(mean[kind].mean()) < float(mean["shewhart"].mean()) - gap


@pytest.mark.parametrize("kind", CHARTS)
def test_unseen_windows_move_nothing_and_a_state_resumes_to_the_bit(kind, fresh_seed):
    generator = torch.Generator().manual_seed(fresh_seed)
    z = torch.randn(30, 5, 2, generator=generator, dtype=torch.float64)
    seen = torch.rand(30, 5, generator=generator) < 0.6
    whole, part = Chart(kind, 5, 20.0), Chart(kind, 5, 20.0)
    for i in range(30):
        before = whole.state_dict()["arms"]
        alarm = whole.step(z[i], seen[i])
        assert not bool((alarm & ~seen[i]).any())
        assert torch.equal(whole.state_dict()["arms"][~seen[i]], before[~seen[i]])
        if i == 12:
            part.load_state_dict(whole.state_dict())
        elif i > 12:
            assert torch.equal(part.step(z[i], seen[i]), alarm)
            assert torch.equal(part.last_statistic, whole.last_statistic)


@pytest.mark.parametrize(("kind", "arl"), [("shewhart", 1.0), ("shewhart", float("nan")), ("cusum", 1.1)])
def test_bad_designs_are_refused(kind, arl):
    with pytest.raises(InputError, match="found"):
        chart_limit(kind, arl)
