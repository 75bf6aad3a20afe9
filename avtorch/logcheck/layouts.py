"""Layouts of known recorders: where each signal of a log lies, and in which unit.

A layout names what its stack calls things; whether a recording has them is seen from its channels. Units are those of
`avtorch.io.units`. Stacks change names between versions, so a signal may have several places, the newest first.
"""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase
from typing import NamedTuple


class Source(NamedTuple):
    """Where a signal lies: the name of a channel, in which ``*`` stands for any part, and its unit, "" for none.

    Where a number stands for a state, `when` lists those that mean yes, as for `engaged`.
    """

    channel: str
    unit: str = ""
    when: tuple[int, ...] = ()


def _layout(**signals: tuple[Source, ...]) -> dict[str, tuple[Source, ...]]:
    return signals


_COMMAND = "/control/command/control_cmd/longitudinal"
_ACTUATION = "/vehicle/status/actuation_status/status"

_AUTOWARE = _layout(
    # the time of a channel is its message's stamp
    accel_cmd=(Source(f"{_COMMAND}/acceleration", "m/s2"),),
    speed=(Source("/vehicle/status/velocity_status/longitudinal_velocity", "m/s"),),
    accel=(Source("/localization/acceleration/accel/accel/linear/x", "m/s2"),),
    # AUTONOMOUS, and AUTONOMOUS_VELOCITY_ONLY
    engaged=(Source("/vehicle/status/control_mode/mode", when=(1, 3)),),
    throttle=(Source(f"{_ACTUATION}/accel_status", "1"),),
    brake=(Source(f"{_ACTUATION}/brake_status", "1"),),
)

_APOLLO = _layout(
    time=(Source("/apollo/canbus/chassis/header/timestamp_sec", "s"),),
    accel_cmd=(Source("/apollo/control/acceleration", "m/s2"),),
    speed=(Source("/apollo/canbus/chassis/speed_mps", "m/s"),),
    # in the vehicle's frame x points right and y forward
    accel=(Source("/apollo/localization/pose/pose/linear_acceleration_vrf/y", "m/s2"),),
    # COMPLETE_AUTO_DRIVE, and AUTO_SPEED_ONLY
    engaged=(Source("/apollo/canbus/chassis/driving_mode", when=(1, 3)),),
    throttle=(Source("/apollo/canbus/chassis/throttle_percentage", "%"),),
    brake=(Source("/apollo/canbus/chassis/brake_percentage", "%"),),
)


def _openpilot(*path: str, unit: str = "", when: tuple[int, ...] = ()) -> tuple[Source, ...]:
    """With dots as in the log's own schema, and with slashes as plotting tools export it."""
    return Source(".".join(path), unit, when), Source("/" + "/".join(path), unit, when)


_OPENPILOT = _layout(
    time=(Source("logMonoTime", "ns"),),
    accel_cmd=_openpilot("carControl", "actuators", "accel", unit="m/s2"),
    speed=_openpilot("carState", "vEgo", unit="m/s"),
    accel=_openpilot("carState", "aEgo", unit="m/s2"),
    # before there was one for each direction, one flag told both
    engaged=_openpilot("carControl", "longActive", when=(1,)) + _openpilot("carControl", "enabled", when=(1,)),
    throttle=_openpilot("carState", "gas", unit="1"),
    brake=_openpilot("carState", "brake", unit="1"),
)

_CARLA = _layout(
    accel_cmd=(Source("/carla/*/ackermann_cmd/acceleration", "m/s2"),),
    speed=(Source("/carla/*/vehicle_status/velocity", "m/s"), Source("/carla/*/speedometer/data", "m/s")),
    throttle=(Source("/carla/*/vehicle_status/control/throttle", "1"),),
    brake=(Source("/carla/*/vehicle_status/control/brake", "1"),),
)

LAYOUTS = {
    "Autoware (ROS 2 bag)": _AUTOWARE,
    "Apollo (cyber record)": _APOLLO,
    "openpilot (qlog or rlog, exported)": _OPENPILOT,
    "CARLA (ROS bridge)": _CARLA,
}
"""By what messages call the stack: the places of each signal by its name, such as ``accel_cmd``."""


def layout_of(names: Iterable[str]) -> tuple[str | None, dict[str, tuple[str, Source]]]:
    """The known layout of a log with columns `names`, which has a command and a response, and for each of its signals
    the column and where it was expected, the first of several matches; nothing otherwise."""
    there = tuple(names)
    for words, signals in LAYOUTS.items():
        found: dict[str, tuple[str, Source]] = {}
        for signal, sources in signals.items():
            matches = ((name, source) for source in sources for name in there if fnmatchcase(name, source.channel))
            if (first := next(matches, None)) is not None:
                found[signal] = first
        if "accel_cmd" in found and ("speed" in found or "accel" in found):
            return words, found
    return None, {}
