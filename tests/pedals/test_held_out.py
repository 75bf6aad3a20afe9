"""The score on blocks left out: a map scores better where the car has one, and not where it has none."""

from __future__ import annotations

from avtorch.pedals import fit_pedals
from tests.pedals.cars import drive, factors, with_dead_zone


def test_a_map_beats_one_factor_where_the_car_has_one() -> None:
    assert fit_pedals(drive(with_dead_zone, 21, seconds=100.0)).held_out.better_than("factor")


def test_a_map_is_not_said_to_beat_the_factor_that_the_car_is() -> None:
    score = fit_pedals(drive(factors, 22, seconds=100.0)).held_out
    assert not score.better_than("factor")
    # wind and road foretell nothing, and that is all that is left
    assert score.rmse("map") < 0.6
