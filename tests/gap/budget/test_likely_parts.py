"""Which of several unlikely effects leaves."""

from __future__ import annotations

from collections.abc import Collection
from types import SimpleNamespace
from typing import Any

import pytest

from avtorch.gap.budget import likely_parts


@pytest.mark.parametrize(
    ("drives_to_a_limit", "leaves"),
    [
        (set(), "resistance"),
        ({"resistance"}, "drag"),
        ({"resistance", "drag"}, "creep"),
        ({"resistance", "drag", "creep"}, "resistance"),
    ],
)
def test_the_one_that_drives_no_other_to_a_limit(
    drives_to_a_limit: Collection[str], leaves: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(selection: Any, name: str) -> Any:
        return name

    monkeypatch.setattr(likely_parts, "_without", without)
    monkeypatch.setattr(likely_parts, "_rests", lambda name: name in drives_to_a_limit)
    whole: Any = None
    assert likely_parts._without_one_of(whole, ["resistance", "drag", "creep"]) == leaves


def test_what_the_going_of_an_immaterial_effect_does_to_the_others_is_looked_at_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A dead time of 47 nats beside a filter that is no part had 300 without it."""

    def drives(*names: str, anew: bool) -> Any:
        return SimpleNamespace(steps=("bare", *names), last=SimpleNamespace(fit=names), anew=anew)

    monkeypatch.setattr(
        likely_parts, "largest_first", lambda s, material, seed: s if s.anew else drives("dead_time", anew=False)
    )
    monkeypatch.setattr(likely_parts, "_asked_anew", lambda s, fit: drives(*fit, anew=True))
    found: Any = likely_parts._parts(drives("sensor_lag", "dead_time", anew=False), 0.03, 0)
    assert (found.steps, found.anew) == (("bare", "dead_time"), True)
    # where none leaves nothing is asked
    kept: Any = likely_parts._parts(drives("dead_time", anew=False), 0.03, 0)
    assert not kept.anew
