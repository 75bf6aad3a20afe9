"""How far a whole diagnosis is: it never goes back, and ends where its last stage ends."""

from __future__ import annotations

from avtorch import GLVDPlant, Leader, diagnose, simulate
from avtorch.gap.whole_progress import STEPS, WholeProgress


def _told(*steps: tuple[str, int, int]) -> list[int]:
    told: list[int] = []
    whole = WholeProgress(lambda what, done, of: told.append(done))
    for step in steps:
        whole(*step)
    return told


def test_a_stage_that_is_made_again_does_not_turn_it_back() -> None:
    told = _told(
        ("single effects", 5, 10), ("pairs", 1, 4), ("single effects", 5, 10), ("pairs", 1, 4), ("pairs", 3, 4)
    )
    assert told == sorted(told)
    assert told[1] == told[2] == told[3] < told[4] < STEPS


def test_each_round_of_the_budget_takes_half_of_what_is_left() -> None:
    rounds = [(f"budget, effect {k}: dead_time", done, 4) for k in range(20) for done in (0, 1, 2, 3)]
    told = _told(("budget", 0, 1), *rounds)
    assert told == sorted(told)
    assert told[0] < told[4] < told[8] < told[12] <= STEPS


def test_a_stage_that_nobody_expects_leaves_it_where_it_is() -> None:
    assert _told(("pairs", 1, 2), ("something else", 3, 4))[1] == _told(("pairs", 1, 2))[0]


def test_a_diagnosis_tells_steps_of_the_whole() -> None:
    log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=GLVDPlant(0.5, 0.9)).log()
    told: list[tuple[str, int, int]] = []
    diagnose(log, effects=["dead_time", "sensor_bias"], progress=lambda *step: told.append(step))
    assert {of for *_, of in told} == {STEPS}
    done = [done for _, done, _ in told]
    assert done == sorted(done)
    assert {"single effects", "random effects"} <= {what for what, *_ in told}
