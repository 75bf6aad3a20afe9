"""What another effect would stand in for beside the limits of what a fit may take keeps its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.blindtest import put_in_front
from avtorch.gap import gap_budget
from avtorch.io import Log
from benchmarks.budgets import joined

ASKED = ["dead_time", "driveline_oscillation", "second_order_actuator", "brake_throttle_asymmetry", "gust"]


@pytest.mark.slow
def test_a_dead_time_is_no_driveline_that_rings_by_twice_the_step(data_dir: Path) -> None:
    """A driveline at its limits gained 160 nats more, the dead time left as redundant, then the driveline as resting at
    a limit, and nothing was named. And what shook the actuator was a gust beside the short lag that is left to it."""
    laps = joined([Log.read(data_dir / "genesis" / f"lap{number}.csv") for number in (1, 2, 3)])
    late, truth = put_in_front(laps, "dead_time", T_L=0.283, K_L=1.05, size=0.8)
    found = gap_budget(late, effects=ASKED)
    assert found.names == ("dead_time",)
    delay = found.parts[0].parameters["delay_s"].mean
    # the car's own, 0.14 s, comes on top
    assert truth["delay_s"] < delay < truth["delay_s"] + 0.3
