"""Recordings whose command is no acceleration: on blocks left out the map beats one constant a pedal."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.pedals import fit_pedals
from benchmarks.pedals import RECORDINGS, read

QUICK = "roboracer, one mass"


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in RECORDINGS])
def test_the_map_beats_one_factor(name: str, data_dir: Path) -> None:
    score = fit_pedals(read(name, data_dir)).held_out
    assert score.rmse("map") < score.rmse("factor")
