"""Followers out of recordings: the right columns, the longest stretch in which all is known, clear refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import read_following


def platoon(path: Path, *, lost: int | None = None) -> Path:
    """Three vehicles at 10 Hz in the AstaZero form; in row `lost` the second spacing is empty."""
    lines = ["Time,X1,SpeedDoppler1,SpeedDoppler2,SpeedDoppler3,Spacing2,Spacing3"]
    for k in range(100):
        t, v = 1 + 0.1 * k, 20 + np.sin(0.05 * k)
        gap = "" if k == lost else f"{25 + 0.01 * k}"
        lines.append(f"{t:.1f},{20 * t},{v + 0.3},{v + 0.2},{v},{30 - 0.01 * k},{gap}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_follower_gets_its_own_gap_and_the_speed_ahead(tmp_path: Path) -> None:
    path = platoon(tmp_path / "p.csv")
    log = read_following(path, vehicle=3)
    assert log.name == "p, vehicle 3"
    assert log.accel_cmd is None
    assert log.accel is None
    assert log.speed is not None
    assert log.lead_speed is not None
    assert log.spacing is not None
    np.testing.assert_allclose(log.lead_speed - log.speed, 0.2)
    np.testing.assert_allclose(log.spacing[:2], [25.0, 25.01])
    assert read_following(path).name == "p, vehicle 2"


def test_the_longest_stretch_is_kept_and_reported(tmp_path: Path) -> None:
    log = read_following(platoon(tmp_path / "p.csv", lost=30), vehicle=3)
    assert log.rows == 69
    assert log.remarks == ("the longest stretch behind one leader with all known, rows 32 to 100 of 100",)


def test_another_leader_begins_another_stretch(tmp_path: Path) -> None:
    path = platoon(tmp_path / "p.csv")
    lines = path.read_text(encoding="utf-8").splitlines()
    cells = [line.split(",") for line in lines[1:]]
    for row in cells[40:]:
        row[6] = str(float(row[6]) - 12)
    path.write_text("\n".join([lines[0], *(",".join(row) for row in cells)]) + "\n", encoding="utf-8")
    log = read_following(path, vehicle=3)
    assert log.remarks == ("the longest stretch behind one leader with all known, rows 41 to 100 of 100",)


def test_other_vehicles_are_refused(tmp_path: Path) -> None:
    path = platoon(tmp_path / "p.csv")
    with pytest.raises(InputError, match="vehicle 1 follows nobody in it; followers: 2, 3"):
        read_following(path, vehicle=1)


def test_a_recording_fixes_its_own_columns(tmp_path: Path) -> None:
    path = platoon(tmp_path / "p.csv")
    with pytest.raises(InputError, match=r"p\.csv: unit has no meaning for a file of this form"):
        read_following(path, vehicle=3, unit={"speed": "km/h"})
    with pytest.raises(InputError, match="event 1 has no meaning"):
        read_following(path, vehicle=3, event=1)


def test_a_plain_log_has_no_vehicles(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    rows = "\n".join(f"{0.1 * k:.1f},20,{25 + 0.01 * k},20.1" for k in range(50))
    path.write_text("time,speed,spacing,lead_speed\n" + rows + "\n", encoding="utf-8")
    assert read_following(path).rows == 50
    with pytest.raises(InputError, match="vehicle 2 has no meaning"):
        read_following(path, vehicle=2)


@pytest.mark.parametrize(
    ("name", "vehicle", "rows"),
    [
        ("openacc_astazero/ASta_040719_platoon7.csv", 5, 9000),
        ("openacc_zalazone/handling_part1.csv", 3, 1000),
        ("openacc_zalazone/dynamic_part12.csv", 3, 500),
        ("i24/2021-03-12-22-20-57_0.csv", None, 4000),
        ("ngsim/events_000_249.csv", None, 100),
    ],
)
def test_recordings(data_dir: Path, name: str, vehicle: int | None, rows: int) -> None:
    log = read_following(data_dir / name, vehicle=vehicle)
    assert log.rows >= rows
    assert log.spacing is not None
    assert log.speed is not None
    assert log.lead_speed is not None
    assert (log.spacing > 0).all()
    # the gap opens as fast as the leader is faster, up to what positions and radars are off by
    change = np.diff(log.spacing)
    foretold = np.diff(log.time) * (log.lead_speed - log.speed)[:-1]
    assert np.corrcoef(np.cumsum(change), np.cumsum(foretold))[0, 1] > 0.9


def test_a_gap_that_is_another_leaders_is_refused(data_dir: Path) -> None:
    with pytest.raises(InputError, match="the spacing grew by -19 m where the speeds imply 509 m"):
        read_following(data_dir / "i24/2021-03-08-22-35-14_0.csv")
