"""Recordings where there are some, US06 where there are none, one line where the folder is not what it should be."""

from __future__ import annotations

from pathlib import Path

import pytest

from avtorch.errors import InputError
from avtorch.paper import Leaders
from avtorch.paper.leaders import DRIVE_S, PLATOON_S, SWEEP_S


def test_without_recordings_us06_is_reported() -> None:
    leaders = Leaders.read()
    assert [a.name for a in (*leaders.sweep, *leaders.drives)] == ["US06", "US06"]
    assert leaders.main.with_note("As it is.") == (
        "As it is; no recordings were given, so the embedded US06 drives ahead."
    )
    assert leaders.main.leader.duration >= PLATOON_S


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a folder"):
        Leaders.read(tmp_path / "none")
    with pytest.raises(InputError, match=r"has no ngsim/events_000_249\.csv"):
        Leaders.read(tmp_path)


def test_recordings(data_dir: Path) -> None:
    leaders = Leaders.read(data_dir)
    assert all(a.leader.duration >= SWEEP_S and not a.note for a in leaders.sweep)
    assert all(a.leader.duration >= DRIVE_S for a in leaders.drives)
    assert leaders.main.leader.duration >= PLATOON_S
    assert list(leaders.descriptions) == ["NGSIM 156", "OpenACC ZalaZONE", "OpenACC AstaZero"]
    assert leaders.descriptions["NGSIM 156"].startswith("event 156, 50.2 s")
