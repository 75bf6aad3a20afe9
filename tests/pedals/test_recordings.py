"""Recordings whose command is no acceleration: on blocks held out the map beats the static factor that is usual."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.pedals import held_out
from benchmarks.pedals import RECORDINGS, read

# 26 s at one speed: too little for a map, and one factor does better
STEADY = "roboracer, other mass"
QUICK = "roboracer, one mass"


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in RECORDINGS])
def test_the_map_beats_the_nominal_factor(name: str, data_dir: Path) -> None:
    score = held_out(read(name, data_dir))
    assert score.better_than("nominal")
    assert (score.rmse("map") < score.rmse("factor")) == (name != STEADY)
