"""The map itself: monotone whatever is fitted, the same in columns and in tables, refused where it turns back."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avtorch.errors import InputError
from avtorch.pedals import PedalMap, PedalTable
from avtorch.pedals.columns import MapColumns
from avtorch.pedals.pedal_drive import Piece
from avtorch.pedals.pedal_map import SIGN
from tests.pedals.cars import drive, plain

COLUMNS = MapColumns(
    np.array([0.0, 4.0, 11.0, 30.0]),
    {"current": np.array([-3.0, -1.0, 0.0, 2.0, 8.0]), "brake": np.array([0.0, 0.1, 1.0])},
)


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 2**32 - 1))
def test_it_is_monotone_by_construction_and_columns_are_tables(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factors = rng.exponential(1.0, COLUMNS.count) * (rng.random(COLUMNS.count) < 0.7)
    factors[: COLUMNS.free] = rng.normal(size=COLUMNS.free)
    made = COLUMNS.map_of(factors, None, 0.3, 0.0)
    speed = rng.uniform(-1.0, 35.0, 60)
    pedals = {"current": rng.uniform(-3.0, 8.0, 60), "brake": rng.uniform(0.0, 1.0, 60)}
    more = {name: x + rng.uniform(0.0, 1.0) for name, x in pedals.items()}
    for name, sign in SIGN.items():
        if name in pedals:
            gain = made.accel(speed, **(pedals | {name: more[name]})) - made.accel(speed, **pedals)
            assert (sign * gain >= -1e-12).all()
    edges = np.append(speed, speed[-1])
    piece = Piece(0.05, pedals, edges, None, np.zeros(60, int), 0, slice(0, 60))
    assert COLUMNS.of(piece) @ factors == pytest.approx(made.accel(piece.middle, **pedals), abs=1e-9)
    at_rest = made.accel(COLUMNS.speed, current=np.zeros(4), brake=np.zeros(4))
    assert at_rest == pytest.approx(made.coasting)


def test_a_straight_map_has_no_curvature() -> None:
    """Whatever is linear in the pedal and in speed costs nothing, so that is what a short drive is given."""
    columns = COLUMNS
    straight = [0.2 - 0.03 * columns.speed]
    for knots in columns.pedal.values():
        straight.append(np.outer(np.diff(knots), 1.0 + 0.1 * columns.speed).ravel())
    assert columns.roughness() @ np.concatenate(straight) == pytest.approx(0.0, abs=1e-9)


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


def test_no_round_off_makes_a_map_turn_back() -> None:
    """A saturation is a ramp of height zero; the same numbers summed in another order may differ in the last bit."""
    rng = np.random.default_rng(0)
    columns = MapColumns(np.array([0.0, 10.0, 20.0, 30.0]), {"throttle": np.sort(np.append(0.0, rng.uniform(0, 1, 8)))})
    for _ in range(200):
        factors = np.where(rng.uniform(size=columns.count) < 0.5, 0.0, rng.uniform(size=columns.count))
        made = columns.map_of(factors, None, 0.3, 0.0)
        assert (np.diff(made.pedals["throttle"].accel, axis=0) >= 0).all()
