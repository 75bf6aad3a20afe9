"""Facts known by other means, beside budgets made by hand."""

from __future__ import annotations

import pytest

from benchmarks.known_facts import FACTS, HEADER, closing, told
from benchmarks.recordings import SETS
from tests.benchmarks.test_effects_in_front import made, part


def test_a_figure_in_the_interval_holds() -> None:
    (inside,) = told("indy_av21", made(part("sensor_lag", lag_s=(2.45, 2.3, 2.6))))
    (beside,) = told("indy_av21", made(part("sensor_lag", lag_s=(2.4, 2.38, 2.43))))
    assert (inside.holds, beside.holds) == (True, False)
    assert (
        str(inside)
        == "| indy_av21 | the accelerometer's low-pass | 2.5 s | sensor_lag 50%: 2.45 (2.3 to 2.6) | holds |"
    )
    assert str(beside).endswith("| sensor_lag 50%: 2.4 (2.38 to 2.43) | does not hold |")


def test_a_cause_that_is_not_named_has_no_figure() -> None:
    (missed,) = told("roboracer, one mass", made())
    assert missed.holds is None
    expected = "| roboracer, one mass | the accelerometer's offset | -0.228 m/s² | sensor_bias is not named | |"
    assert str(missed) == expected


def test_a_cause_without_a_figure_is_right_where_it_is_named() -> None:
    (right,) = told("volvo_truck", made(part("road_grade", grade_rms=(0.016, 0.012, 0.021))))
    assert right.holds is None
    assert str(right).endswith("| no figure | road_grade 50%: 0.016 (0.012 to 0.021) | right cause |")
    (missed,) = told("volvo_truck", made(part("dead_band", half_width_mps2=(0.1, 0.05, 0.2))))
    assert str(missed).endswith("| no figure | road_grade is not named | |")


def test_the_genesis_lag_is_with_its_dead_time() -> None:
    late = made(part("dead_time", delay_s=(0.14, 0.1, 0.18)), T_L=0.2, K_L=1.2)
    lag, gain = told("genesis, lap 1", late)
    assert lag.found is not None
    assert (lag.found.mean, lag.found.q05, lag.found.q95) == pytest.approx((0.34, 0.28, 0.4))
    assert (lag.holds, gain.holds) == (True, False)
    assert "| 0.32 s | T_L with delay_s 0.34 (0.28 to 0.4) | holds |" in str(lag)
    assert "| 0.96 | K_L 1.2 (1.18 to 1.22) | does not hold |" in str(gain)
    alone, _ = told("genesis, lap 1", made(T_L=0.3))
    assert alone.found is not None
    assert alone.found.mean == 0.3


def test_figures_are_counted_with_and_without_a_name() -> None:
    cars = {
        "indy_av21": made(part("sensor_lag", lag_s=(2.45, 2.3, 2.6))),
        "roboracer, tyres": made(),
        "volvo_truck": made(part("road_grade", grade_rms=(0.016, 0.012, 0.021))),
        "dart, 10:02": made(part("constant_resistance", resistance_mps2=(1.7, 1.2, 2.1))),  # nothing is known of it
    }
    facts = [fact for name, budget in cars.items() for fact in told(name, budget)]
    assert len(facts) == 3
    assert closing(facts) == (
        "intervals that hold the figure: 1 of 2 (12 to 88 %), of those with a name 1 of 1 (27 to 100 %)"
    )


def test_facts_are_of_recordings_that_are_answered() -> None:
    assert FACTS.keys() <= SETS.keys()
    columns = HEADER.splitlines()[0].count("|")
    assert all(str(fact).count("|") == columns for name in FACTS for fact in told(name, made()))
