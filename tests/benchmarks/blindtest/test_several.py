"""Cases of several causes: how many, how strong, what the truth tells."""

from __future__ import annotations

import json

import numpy as np
import pytest

from avtorch.errors import InputError
from benchmarks.blindtest import CALIBRATION, EFFECTS, MIX, SEALED, draw_case, family
from benchmarks.blindtest.deck import kind_of
from benchmarks.blindtest.several import COUNTS, LEAST_GAP, STRENGTHS, draw_several
from benchmarks.blindtest.strength import excess_range
from tests.bars import BAR

SHORT = {"mix": {"several": 1.0}, "seconds": 30.0}


@pytest.mark.slow
def test_three_to_five_that_can_be_seen(fresh_seed: int) -> None:
    case = draw_case(0, fresh_seed, **SHORT)
    assert case.kind == "several"
    assert len(case.names) in COUNTS
    assert case.names == tuple(sorted(case.names))
    least = np.hypot(1, excess_range("hard")[0])
    assert case.visibility_each.keys() == set(case.names) == case.parameters.keys()
    assert min(case.visibility_each.values()) >= least - 1e-9
    assert case.truth_name == "+".join(name for name in case.names if name in EFFECTS)
    assert "gain_change" not in case.names or not case.onset_scored
    again = draw_case(0, fresh_seed, **SHORT)
    np.testing.assert_array_equal(again.run.accel, case.run.accel)
    assert sum(not family(name).by_chance for name in case.names) >= 2
    with pytest.raises(InputError, match="several at once need five"):
        draw_case(0, fresh_seed, effects=["gust", "dead_time", "outliers", "backlash", "command_hold"], **SHORT)


@pytest.mark.slow
def test_the_truth_divides_the_gap(fresh_seed: int) -> None:
    case = draw_case(1, fresh_seed, signals=("speed",), **SHORT)
    truth = json.loads(json.dumps(case.truth(), allow_nan=False))
    budget = truth["budget"]
    assert list(budget["by_channel"]) == ["speed"]  # the channels that the case was drawn for
    parts = {part["names"][0]: part["share"] for part in budget["parts"]}
    assert sum(parts.values()) + budget["unexplained"]["share"] == pytest.approx(1.0)
    chance = {part["names"][0] for part in budget["chance"]}
    assert parts.keys() | chance | set(truth["outside"]) == set(case.names)
    assert truth["outside"] == [name for name in case.names if name not in EFFECTS]
    assert (budget["unexplained"]["share"] > 0) <= bool(truth["outside"])
    assert "budget" not in draw_case(0, fresh_seed, mix={"none": 1.0}, seconds=10.0).truth()


@pytest.mark.statistical
def test_every_fifth_begins_with_a_cause_outside_the_table(rotating_seed: int) -> None:
    rng, trials = np.random.default_rng(rotating_seed), 2000
    firsts = [draw_several(rng, list(EFFECTS), SEALED) for _ in range(trials)]
    outside = [order[0].name in SEALED for order, _ in firsts]
    assert abs(np.mean(outside) - 0.2) < BAR * np.sqrt(0.2 * 0.8 / trials)
    assert {count for _, count in firsts} == set(COUNTS)
    assert not any(f.name == "command_hold" for order, _ in firsts for f in order)
    assert not any(f.name in CALIBRATION for order, _ in firsts for f in order)


@pytest.mark.slow
def test_sizes_are_ordinary_and_the_gap_is_there(fresh_seed: int) -> None:
    """Strengths are those of ordinary cars, not solved for: of an effect whose size is a number, within its range."""
    cases = [draw_case(i, fresh_seed, **SHORT) for i in range(12)]
    sizes = {"constant_resistance": ("resistance_mps2", 0.15), "dead_time": ("delay_s", 0.2)}
    sizes |= {"sensor_lag": ("lag_s", 0.2), "dead_band": ("half_width_mps2", 0.12)}
    found = [
        case.parameters[name][key] / middle
        for case in cases
        for name, (key, middle) in sizes.items()
        if name in case.names
    ]
    assert found
    assert min(found) >= STRENGTHS[0] - 1e-9
    assert max(found) <= STRENGTHS[1] + 1e-9
    for case in cases[:4]:
        budget = case.budget
        assert budget is not None
        # the fit of lag and gain takes a little from the gap that was found without it
        assert budget["before"] > 0.7 * LEAST_GAP


def test_the_default_mix_has_none_of_them() -> None:
    assert "several" not in MIX
    assert {kind_of(i, 3)[0] for i in range(20)} == set(MIX)
    assert [kind_of(i, 3, {"several": 0.5, "none": 0.5})[0] for i in range(20)].count("several") == 10
    with pytest.raises(InputError, match="several that sum to 1"):
        kind_of(0, 3, {"several": 0.5})
