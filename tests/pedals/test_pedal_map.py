"""The map itself, refused where it turns back."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.pedals import PedalMap, PedalTable
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
