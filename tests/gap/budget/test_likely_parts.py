"""Which of several unlikely effects leaves."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import pytest

from avtorch.gap.budget import likely_parts
from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.selection_step import Selection, Step


@pytest.mark.parametrize(
    ("drives_to_a_limit", "leaves"),
    [
        ({}, "resistance"),
        ({"resistance": "creep"}, "drag"),
        ({"resistance": "creep", "drag": "resistance"}, "creep"),
        ({"resistance": "drag", "drag": "resistance", "creep": "drag"}, "resistance"),
        # a likely one that only stands in for the unlikely
        ({"resistance": "gear", "drag": "gear", "creep": "gear"}, "gear"),
    ],
)
def test_the_one_that_drives_no_other_to_a_limit(
    drives_to_a_limit: Mapping[str, str], leaves: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(selection: Any, name: str) -> Any:
        return SimpleNamespace(last=SimpleNamespace(fit=name))  # the fit of the others

    def resting(fit: Any) -> list[str]:
        return [drives_to_a_limit[fit]] if fit in drives_to_a_limit else []

    monkeypatch.setattr(likely_parts, "_without", without)
    monkeypatch.setattr(likely_parts, "at_limits", resting)
    whole: Any = None
    assert cast(Any, likely_parts._without_one_of(whole, ["resistance", "drag", "creep"])).last.fit == leaves


def test_beside_an_effect_that_is_no_part_the_evidence_is_asked_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A dead time of 47 nats beside a filter that is no part had 300 without it; none leaves by that."""
    weak, strong = Evidence(47.0, 3.0, 10), Evidence(300.0, 9.0, 10)

    def selection(*names: str) -> Any:
        steps = [Step(cast(Any, name), cast(Any, None), name, weak) for name in names]
        return Selection(cast(Any, None), (Step(cast(Any, "bare"), cast(Any, None)), *steps), 3)

    monkeypatch.setattr(likely_parts, "largest_first", lambda s, material, seed: selection("dead_time"))
    monkeypatch.setattr(likely_parts, "evidence_by_own_noise", lambda fitting, judging, fit: {fit: strong})
    found = likely_parts._parts(selection("sensor_lag", "dead_time"), 0.03, 0)
    assert [(step.entered, step.evidence) for step in found.steps[1:]] == [("dead_time", strong)]
    # where none leaves nothing is asked
    assert likely_parts._parts(selection("dead_time"), 0.03, 0).steps[1].evidence == weak


@pytest.mark.parametrize(
    ("stays", "leaves", "alone", "sure"),
    [
        # a gain of the Genesis that changes was likely beside a dead band at 0.49, and nothing was named
        (("gain_change", 0.84), ("dead_band", 0.4), 0.3, 0.4 * 0.84 + 0.6 * 0.3),
        # the AV-21's drag rested at a limit without the resistance; both were gone, and a dead band stood in for them
        (("constant_resistance", 0.04), ("aerodynamic_drag", 0.66), 0.98, 0.98),
    ],
)
def test_an_effect_is_as_likely_as_beside_and_without_one_that_leaves(
    stays: tuple[str, float], leaves: tuple[str, float], alone: float, sure: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is likely itself leaves only as it stands in for another."""

    def selection(*names: str) -> Any:
        steps = [Step(cast(Any, name), cast(Any, None), name) for name in ("bare", *names)]
        return Selection(cast(Any, None), tuple(steps), 3)

    each = {2: dict((stays, leaves)), 1: {stays[0]: alone}}
    monkeypatch.setattr(likely_parts, "_parts", lambda selection, material, seed: selection)
    monkeypatch.setattr(likely_parts, "with_sizes", lambda selection: selection)
    monkeypatch.setattr(likely_parts, "at_limits", lambda fit: [])
    monkeypatch.setattr(likely_parts, "probabilities", lambda selection: dict(each[len(selection.steps) - 1]))
    monkeypatch.setattr(likely_parts, "_without_one_of", lambda s, names: selection(stays[0]))
    found = likely_parts.likely_parts(selection(stays[0], leaves[0]))
    assert found.sure == pytest.approx({stays[0]: sure})
    assert [step.entered for step in found.steps[1:]] == [stays[0]]
