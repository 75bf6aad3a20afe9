"""Files of a map: whole, and in the layout that vehicle interfaces take."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from avtorch.pedals import PedalMap, PedalTable, accel_table, brake_table, fit_pedals, write_map
from tests.pedals.cars import drive, plain


def test_the_whole_map_is_written(tmp_path: Path) -> None:
    made = fit_pedals(drive(plain, 31, seconds=60.0)).map
    files = write_map(made, tmp_path)
    assert [file.name for file in files] == ["pedal_map.csv", "accel_map.csv", "brake_map.csv"]
    with open(files[0], newline="") as stream:
        rows = list(csv.DictReader(line for line in stream if not line.startswith("#")))
    found = {name: [row for row in rows if row["pedal"] == name] for name in ("coasting", *made.pedals)}
    for name, column in (("coasting", made.coasting), *((n, t.accel.ravel()) for n, t in made.pedals.items())):
        assert np.array_equal([float(row["accel"]) for row in found[name]], column)
    for name, table in made.pedals.items():
        assert np.array_equal([float(row["value"]) for row in found[name]], table.pedal.repeat(len(made.speed)))
        assert table.sd is not None
        assert np.array_equal([float(row["sd"]) for row in found[name]], table.sd.ravel())
    last = {row["pedal"]: (float(row["value"]), float(row["speed"])) for row in rows[-3:]}
    assert last["lag"][0] == pytest.approx(made.T_L)
    assert last["delay"][0] == pytest.approx(made.dead_time)
    assert last["driven"] == pytest.approx(made.driven)


def test_the_tables_are_the_map(tmp_path: Path) -> None:
    made = fit_pedals(drive(plain, 31, seconds=60.0)).map
    write_map(made, tmp_path)
    for file, name in (("accel_map.csv", "throttle"), ("brake_map.csv", "brake")):
        with open(tmp_path / file, newline="") as stream:
            head, *rows = list(csv.reader(stream))
        assert head[0] == "default"
        speed = np.array(head[1:], float)
        assert (np.diff(speed) > 0).all()
        for row in rows:
            rest = {other: np.zeros(len(speed)) for other in made.pedals}
            want = made.accel(made.speed, **(rest | {name: np.full(len(speed), float(row[0]))}))
            assert np.array(row[1:], float) == pytest.approx(want, abs=1e-3)  # three decimals, and those of the pedal


def test_what_a_table_does_not_hold_is_told() -> None:
    torque = PedalTable(np.array([0.0, 600.0]), np.array([[0.0, 0.0], [2.0, 1.0]]))
    made = PedalMap(np.array([0.0, 20.0]), np.array([0.0, -0.2]), {"torque": torque})
    table = accel_table(made)
    assert table is not None
    assert "the unit of torque: a pedal of 1 is 600 Nm" in table.lost
    assert any(words.startswith("lag") for words in table.lost)
    assert brake_table(made) is None


@pytest.mark.parametrize("name", ["throttle", "brake"])
def test_a_table_of_plateaus_can_be_inverted(name: str, tmp_path: Path) -> None:
    """A dead zone, a plateau and a saturation: each command comes back as the pedal that gives it."""
    sign = -1.0 if name == "brake" else 1.0
    pedal = np.array([0.0, 0.1, 0.4, 0.6, 0.9, 1.0])
    accel = sign * np.outer([0.0, 0.0, 1.2, 1.2, 3.0, 3.0], [1.0, 0.7])
    made = PedalMap(np.array([0.0, 20.0]), np.array([0.05, -0.3]), {name: PedalTable(pedal, accel)})
    write_map(made, tmp_path)
    file = "brake_map.csv" if name == "brake" else "accel_map.csv"
    with open(tmp_path / file, newline="") as stream:
        _, *rows = list(csv.reader(stream))
    table = np.array(rows, float)
    assert np.allclose(table[:, 0], pedal)
    rising = sign * table[:, 1:]
    assert (np.diff(rising, axis=0) > 5e-4).all()
    for column in rising.T:
        given = np.linspace(column[0], column[-1], 200)
        back = np.interp(np.interp(given, column, pedal), pedal, column)
        assert np.allclose(back, given, atol=1e-9)
    assert np.allclose(table[:, 1:], accel + made.coasting, atol=0.0065), "each flat step costs one digit"
    written = brake_table(made) if name == "brake" else accel_table(made)
    assert written is not None
    assert any("steps of" in words and "inverted" in words for words in written.lost)


def test_a_brake_in_newton_metres_is_no_pressure() -> None:
    brake = PedalTable(np.array([0.0, 2760.0]), np.array([[0.0, 0.0], [-6.0, -6.0]]))
    table = brake_table(PedalMap(np.array([0.0, 20.0]), np.zeros(2), {"brake": brake}))
    assert table is not None
    assert "the unit of brake: a pedal of 1 is 2760 Nm" in table.lost
