"""Roads of the length of a real drive: their waves are much shorter than the drive."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.blindtest import draw_case
from avtorch.gap import gap_budget
from avtorch.io import Log


@pytest.mark.slow
def test_a_steep_road_of_many_waves_is_named() -> None:
    # seven kilometres with waves of 235 m: a dozen knots could not follow them, and two coefficients were at a limit
    case = draw_case(0, 7002, mix={"single": 1.0}, effects=["road_grade"], tiers=["easy"], seconds=300.0)
    assert gap_budget(case.log(), effects=["road_grade", "constant_resistance"]).names == ("road_grade",)


@pytest.mark.slow
def test_a_truck_on_a_grade_has_no_lag_of_ten_seconds(data_dir: Path) -> None:
    """A dead band with such a lag explains as much of it with far fewer parameters, and was named."""
    truck = Log.read(data_dir / "volvo_truck" / "052311_grade.csv")
    found = gap_budget(truck, effects=["dead_band", "road_grade"])
    assert found.names == ("road_grade",)
    assert found.parts[0].alias_set == ("dead_band", "road_grade")
    assert found.repaired["T_L"].q95 < 2.0
