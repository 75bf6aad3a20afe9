"""Roads of the length of a real drive: their waves are much shorter than the drive."""

from __future__ import annotations

from avtorch.blindtest import draw_case
from avtorch.gap import gap_budget


def test_a_road_of_many_waves_is_named() -> None:
    # seven kilometres with waves of some two hundred metres: a dozen knots over the whole way could not follow them
    case = draw_case(1, 7002, mix={"single": 1.0}, effects=["road_grade"], tiers=["easy"], seconds=300.0)
    budget = gap_budget(case.log(), effects=["road_grade", "constant_resistance", "aerodynamic_drag"])
    assert budget.names[:1] == ("road_grade",)


def test_a_steep_road_is_named() -> None:
    # of 34 coefficients two were at the limit of a fit, and the whole road was refused
    case = draw_case(0, 7002, mix={"single": 1.0}, effects=["road_grade"], tiers=["easy"], seconds=300.0)
    assert gap_budget(case.log(), effects=["road_grade"]).names == ("road_grade",)
