"""The comparison of printed with shown output sees a wrong word, a wrong number and a missing line."""

from __future__ import annotations

import pytest

from tests.shown_output import matches

PRINTED = "lag   0.504 s  (0.47-0.55)\ntook 3 s\nverdict dead_time ████▍ 0.95\n"


@pytest.mark.parametrize(
    "shown",
    [
        PRINTED,
        "lag 0.508 s (0.47-0.55) took 3 s verdict dead_time ██ 0.94",
        "lag 0.504 s (0.47-0.55)\n...\nverdict dead_time █ 0.95",
        "...\ntook ... s\n...",
    ],
)
def test_alike(shown: str) -> None:
    assert matches(PRINTED, shown)


@pytest.mark.parametrize(
    "shown",
    [
        "lag 0.504 s (0.47-0.55)\ntook 3 s\nverdict backlash █ 0.95",
        "lag 0.504 s (0.47-0.55)\ntook 3 s\nverdict dead_time █ 0.75",
        "lag 0.504 s (0.47-0.55)\ntook 3 s",
        "took 3 s\nverdict dead_time █ 0.95",
        "lag 0.504 s\n...\nverdict none █ 0.95",
        "lag 0.704 s (0.47-0.55)\n...",
        "...\ntook 5 s\n...",
    ],
)
def test_not_alike(shown: str) -> None:
    assert not matches(PRINTED, shown)
