"""Which of several unlikely effects leaves."""

from __future__ import annotations

from collections.abc import Collection
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
