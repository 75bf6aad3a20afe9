"""An effect that took the place of another leaves it again, and a right one stays."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avtorch.blindtest import draw_case
from avtorch.gap import EFFECTS, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.exchange import exchanged, taken_over
from avtorch.gap.budget.forward_selection import baseline_noise
from avtorch.gap.budget.given_effects import given_effects
from avtorch.gap.effects import ConstantResistance, DeadTime

from .cars import log_of

TRIED = [EFFECTS[name] for name in ("constant_resistance", "dead_time", "sensor_bias", "gain_change")]


@pytest.mark.parametrize(
    ("begun", "reached"),
    [
        (("sensor_bias", "dead_time"), {"constant_resistance", "dead_time"}),
        (("constant_resistance", "gain_change"), {"constant_resistance", "dead_time"}),
        (("constant_resistance", "dead_time"), {"constant_resistance", "dead_time"}),
    ],
)
def test_what_blocks_that_were_held_out_prefer_takes_the_place(
    begun: tuple[str, ...], reached: set[str], fresh_seed: int
) -> None:
    log = log_of([ConstantResistance(0.25), DeadTime(0.3)], seed=fresh_seed, seconds=100.0)
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log]), plant([]))
    wrong = given_effects(fitting, bare, [EFFECTS[name] for name in begun], values={}, onsets={})
    now, entered = exchanged(fitting, wrong.last, TRIED)
    assert set(now.fit.model.names) == reached
    assert set(entered) == reached - set(begun)
    assert now.held.nats.sum() <= wrong.last.held.nats.sum()


def test_what_was_chosen_for_its_place_is_not_tried_again(fresh_seed: int) -> None:
    log = log_of([ConstantResistance(0.25), DeadTime(0.3)], seed=fresh_seed, seconds=100.0)
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([log]), plant([]))
    tried: list[str] = []

    def begun_from(*names: str, settled: str) -> set[str]:
        tried.clear()
        start = given_effects(fitting, bare, [EFFECTS[name] for name in names], values={}, onsets={}).last
        now, _ = exchanged(fitting, start, TRIED, lambda role, _a, _b: tried.append(role), settled=settled)
        return set(now.fit.model.names)

    right = {"constant_resistance", "dead_time"}
    # nothing takes the place of the other, so this one is not tried
    assert begun_from("constant_resistance", "dead_time", settled="constant_resistance") == right
    assert any("dead_time" in role for role in tried)
    assert not any("in place of constant_resistance" in role for role in tried)
    # nor is what would be exchanged if it were tried, as the test above does
    assert begun_from("sensor_bias", "dead_time", settled="sensor_bias") == {"sensor_bias", "dead_time"}


@pytest.mark.slow
def test_an_effect_that_entered_beside_one_that_it_does_for_takes_its_place() -> None:
    """A driveline that rings from 305 s on entered as what a second-order actuator from there on leaves, and from the
    start on; the actuator then was no more redundant than it, and was named."""
    ringing = draw_case(27, 100135, recorder="ordinary")
    assert (ringing.names, ringing.onset_s) == (("driveline_oscillation",), pytest.approx(304.7, abs=0.1))
    fitting, bare = baseline_noise(AnalysisRecord.for_budget([ringing.log()]), plant([]))
    pair = [EFFECTS["second_order_actuator"], EFFECTS["driveline_oscillation"]]
    both = given_effects(fitting, bare, pair, values={}, onsets={pair[0].name: 313.5}).last
    assert both.fit.model.names == ("second_order_actuator", "driveline_oscillation")
    entered = replace(both, aliases=("driveline_oscillation", "second_order_actuator"))
    alone = taken_over(fitting, both, {"second_order_actuator": entered}, pair)
    assert alone.fit.model.names == ("driveline_oscillation",)
    assert alone.fit.model.onsets["driveline_oscillation"] == pytest.approx(304.7, abs=10.0)
    # what explains something else stays
    other = replace(both, aliases=("second_order_actuator",))
    assert taken_over(fitting, both, {"second_order_actuator": other}, pair) is both
