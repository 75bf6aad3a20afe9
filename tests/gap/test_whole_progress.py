"""How far a whole diagnosis is: it never goes back, and ends where its last stage ends."""

from __future__ import annotations

from avtorch import GLVDPlant, Leader, diagnose, simulate
from avtorch.gap.diagnose import STEPS, WholeProgress


def _told(*steps: tuple[str, int, int]) -> list[int]:
    told: list[int] = []
    whole = WholeProgress(lambda what, done, of: told.append(done))
    for step in steps:
        whole(*step)
    return told


def test_a_stage_that_is_made_again_does_not_turn_it_back() -> None:
    told = _told(("effects", 1, 4), ("recorder", 0, 1), ("effects", 1, 4), ("effects", 3, 4), ("average", 0, 1))
    assert told == sorted(told)
    assert told[0] == told[1] == told[2] < told[3] < told[4] < STEPS


def test_a_stage_that_nobody_expects_leaves_it_where_it_is() -> None:
    assert _told(("effects", 1, 2), ("something else", 3, 4))[1] == _told(("effects", 1, 2))[0]


def test_a_diagnosis_tells_steps_of_the_whole() -> None:
    log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=GLVDPlant(0.5, 0.9)).log()
    told: list[tuple[str, int, int]] = []
    diagnose(log, effects=["dead_time", "sensor_bias"], progress=lambda *step: told.append(step))
    assert {of for *_, of in told} == {STEPS}
    done = [done for _, done, _ in told]
    assert done == sorted(done)
    assert done[-1] == STEPS
    assert {"recorder", "outliers", "average", "held-out blocks"} <= {what for what, *_ in told}
