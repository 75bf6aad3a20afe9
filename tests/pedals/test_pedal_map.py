"""The map itself, refused where it turns back, and the one of a plant: monotone whatever its table is."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.gap import DeadTime, ForceTable, ResistanceCurve, plant
from avtorch.pedals import PedalCommand, PedalMap, PedalTable, fit_pedals
from tests.pedals.cars import drive, plain


def test_its_command_is_what_others_take() -> None:
    log = drive(plain, 1, seconds=30.0)
    brake = PedalTable(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [-8.0, -8.0]]))
    throttle = PedalTable(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [6.0, 3.0]]))
    made = PedalMap(np.array([0.0, 30.0]), np.array([-0.1, -0.5]), {"throttle": throttle, "brake": brake})
    commanded = made.commanded(log)
    assert commanded.accel_cmd is not None
    assert commanded.accel_cmd.shape == (log.rows,)
    assert log.accel_cmd is None
    with pytest.raises(InputError, match="has no current, which the map needs"):
        PedalMap(made.speed, made.coasting, {"current": throttle}).commanded(log)
    with pytest.raises(InputError, match="found no brake, needs throttle, brake"):
        made.accel(np.ones(2), throttle=np.ones(2))


@pytest.mark.parametrize(
    ("knots", "accel", "told"),
    [
        ([0.0, 1.0], [[0.0, 0.0], [1.0, -0.1]], "turns back"),
        ([0.0, 0.0], [[0.0, 0.0], [1.0, 1.0]], "needs two knots or more that rise"),
        ([0.0, 1.0], [[0.0, 0.0], [1.0, np.nan]], "finite"),
        ([0.0, 1.0], [[0.0], [1.0]], "shape"),
    ],
)
def test_tables_that_are_no_map(knots: list, accel: list, told: str) -> None:
    with pytest.raises(InputError, match=told):
        PedalMap(np.array([0.0, 30.0]), np.zeros(2), {"throttle": PedalTable(np.array(knots), np.array(accel))})
    with pytest.raises(InputError, match="needs some of throttle, brake, torque, current"):
        PedalMap(np.array([0.0, 30.0]), np.zeros(2), {})


COMMAND = PedalCommand({"throttle": 4.0, "brake": 8.0}, {"throttle": (0.0, 1.0), "brake": (0.0, 0.5)}, (0.0, 30.0))
TABLE = ForceTable((-4.0, 0.0, 4.0), (0.0, 30.0), ((1.0, 0.5), (0.0, 0.1), (-1.0, -2.0)))
DRAG = ResistanceCurve((0.0, 30.0), (-0.1, -0.5))


def test_the_map_of_a_plant_is_what_it_does_with_held_pedals() -> None:
    made = COMMAND.map_of(plant([DeadTime(0.2), TABLE, DRAG], T_L=0.4, K_L=0.9))
    assert (made.T_L, made.dead_time) == (0.4, 0.2)
    speed = np.array([30.0, 30.0, 30.0])
    found = made.accel(speed, throttle=np.array([0.5, 0.0, 0.0]), brake=np.array([0.0, 0.0, 0.25]))
    want = [0.9 * 2.0 + 0.5 * (0.1 - 2.0) - 0.5, 0.1 - 0.5, -0.9 * 2.0 + 0.5 * (0.5 + 0.1) - 0.5]
    assert found == pytest.approx(want, abs=1e-6)


def test_a_table_that_turns_back_makes_no_map_that_does() -> None:
    steep = ForceTable((-4.0, 0.0, 2.0, 4.0), (0.0, 30.0), ((0.0, 0.0), (0.0, 0.0), (0.0, 3.0), (-4.0, -3.0)))
    made = COMMAND.map_of(plant([steep]))
    assert (np.diff(made.pedals["throttle"].accel, axis=0) >= 0).all()


def test_the_map_and_the_plant_of_a_fit_are_the_same() -> None:
    log = drive(plain, 2, seconds=60.0)
    fit = fit_pedals(log)
    assert fit.plant is not None
    again = PedalCommand.of(log).map_of(fit.plant)
    for name, table in fit.map.pedals.items():
        assert np.array_equal(again.pedals[name].accel, table.accel)
