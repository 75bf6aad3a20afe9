"""The comparison of printed with shown output sees a wrong word, a wrong number and a missing line."""

from __future__ import annotations

import pytest

from tests.shown_output import matches

PRINTED = "lag   0.504 s  (0.47-0.55)\ntook 3 s\nverdict dead_time ████▍ 0.95\n"


@pytest.mark.parametrize(
    ("shown", "alike"),
    [
        (PRINTED, True),
        ("lag 0.508 s (0.47-0.55) took 3 s verdict dead_time ██ 0.94", True),
        ("lag 0.504 s (0.47-0.55)\n...\nverdict dead_time █ 0.95", True),
        ("...\ntook ... s\n...", True),
        ("lag 0.504 s (0.47-0.55)\ntook 3 s\nverdict backlash █ 0.95", False),
        ("lag 0.504 s (0.47-0.55)\ntook 3 s\nverdict dead_time █ 0.75", False),
        ("lag 0.504 s (0.47-0.55)\ntook 3 s", False),
        ("took 3 s\nverdict dead_time █ 0.95", False),
        ("lag 0.504 s\n...\nverdict none █ 0.95", False),
        ("lag 0.704 s (0.47-0.55)\n...", False),
        ("...\ntook 5 s\n...", False),
    ],
)
def test_alike(shown: str, alike: bool) -> None:
    assert matches(PRINTED, shown) == alike
