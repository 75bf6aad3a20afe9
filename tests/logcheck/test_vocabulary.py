"""What a column may be by its name: flags of other functions are neither who drives nor where a drive ends."""

from __future__ import annotations

import pytest

from avtorch.logcheck.vocabulary import header_of, likeness


@pytest.mark.parametrize(
    "name",
    [
        "ACC_Override",
        "cruise_fault",
        "ACC_Available",
        "AutoHold",
        "acc_brake_active",
        "ABS_Active",
        "ESP_active",
        "turn_signal_active",
        "driver_override",
    ],
)
def test_a_flag_of_something_else_does_not_say_who_drives(name: str) -> None:
    header = header_of(name)
    assert likeness(header, "engaged") == likeness(header, "segment") == 0.0


@pytest.mark.parametrize("name", ["ACC_Active", "cruise_enabled", "autopilot", "ACC aktiv engaged", "acc_status"])
def test_a_flag_of_the_controller_does(name: str) -> None:
    assert likeness(header_of(name), "engaged") > 0.0


@pytest.mark.parametrize("name", ["segment", "lap", "drive_id", "run"])
def test_numbers_of_drives_are_segments(name: str) -> None:
    assert likeness(header_of(name), "segment") > 0.0
