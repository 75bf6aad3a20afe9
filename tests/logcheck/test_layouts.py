"""Layouts of known recorders: found among channels, in signals and units that logs know."""

from __future__ import annotations

from avtorch.io.units import to_si
from avtorch.logcheck.layouts import LAYOUTS, layout_of
from avtorch.logcheck.vocabulary import NAMED_SIGNALS


def test_layouts_speak_of_signals_and_units_that_logs_know() -> None:
    for signals in LAYOUTS.values():
        assert set(signals) <= set(NAMED_SIGNALS)
        for signal, sources in signals.items():
            for source in sources:
                if source.unit:
                    to_si(signal, source.unit)


def test_a_layout_is_found_among_channels() -> None:
    names = [
        "/control/command/control_cmd/longitudinal/acceleration",
        "/vehicle/status/control_mode/mode",
        "/vehicle/status/velocity_status/longitudinal_velocity",
        "/x",
    ]
    words, found = layout_of(names)
    assert words == "Autoware (ROS 2 bag)"
    assert [found[signal][0] for signal in ("accel_cmd", "engaged", "speed")] == names[:3]
    assert found["engaged"][1].when == (1, 3)
    assert layout_of(names[:2]) == (None, {}), "no response"
    words, found = layout_of(["/carla/ego/ackermann_cmd/acceleration", "/carla/ego/vehicle_status/velocity"])
    assert words == "CARLA (ROS bridge)"
    assert found["speed"][1].unit == "m/s"
