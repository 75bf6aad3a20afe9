"""Roads of the length of a real drive: their waves are much shorter than the drive."""

from __future__ import annotations

from avtorch.blindtest import draw_case
from avtorch.gap import gap_budget


def test_a_steep_road_of_many_waves_is_named() -> None:
    # seven kilometres with waves of 235 m: a dozen knots could not follow them, and two coefficients were at a limit
    case = draw_case(0, 7002, mix={"single": 1.0}, effects=["road_grade"], tiers=["easy"], seconds=300.0)
    assert gap_budget(case.log(), effects=["road_grade", "constant_resistance"]).names == ("road_grade",)
