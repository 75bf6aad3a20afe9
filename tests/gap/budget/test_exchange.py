"""An effect that took the place of another leaves it again, and a right one stays."""

from __future__ import annotations

import pytest

from avtorch.gap import EFFECTS, plant
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.exchange import exchanged
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
