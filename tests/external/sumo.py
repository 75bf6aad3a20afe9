"""SUMO as a real part: a car of a `vType` on a straight road, in libsumo, commanded by acceleration."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import libsumo
import numpy as np

from avtorch.io import Log

Law = Callable[[float, float, float], float]

_NET = """<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,90000,0" origBoundary="0,0,90000,0" projParameter="!"/>
  <edge id="road" from="a" to="b" priority="1">
    <lane id="road_0" index="0" speed="80" length="90000" shape="0,0 90000,0"/>
  </edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-3"/>
  <junction id="b" type="dead_end" x="90000" y="0" incLanes="road_0" intLanes="" shape="90000,0 90000,-3"/>
</net>
"""
_ROUTES = """<routes>
  <vType id="leader" accel="20" decel="20" emergencyDecel="20" maxSpeed="80"/>
  <route id="straight" edges="road"/>
</routes>
"""
_LENGTH_M = 5.0  # a passenger car of SUMO; positions are those of front bumpers
_LIMITS_ONLY = 6  # of TraCI's speed mode: the limits of acceleration hold, the distance to a leader is the caller's


class SumoCar:
    """A `Simulator`: a car of the type `car` in the additional file `types`, in steps of `dt` [s].

    It begins without acceleration. `plexe`: its commands go to the controllers of the model CC, and so by its engine.
    There is one simulation in a process: whoever is reset has it.
    """

    def __init__(self, folder: Path, types: Path, *, dt: float = 0.1, plexe: bool = False) -> None:
        self._folder, self._types, self._dt, self._plexe = folder, types, dt, plexe

    def reset(self, *, speed: float, accel: float) -> None:
        begin(self._folder, self._types, self._dt, {"car": 1000.0}, speed)
        for name, value in {"ccac": "1", "ccds": "80"}.items() if self._plexe else ():
            libsumo.vehicle.setParameter("car", f"carFollowModel.{name}", value)

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        assert abs(dt - self._dt) < 1e-6
        if self._plexe:
            libsumo.vehicle.setParameter("car", "carFollowModel.ccfa", f"1:{accel_cmd!r}")
        else:
            libsumo.vehicle.setAcceleration("car", accel_cmd, dt)
        libsumo.simulationStep()
        return libsumo.vehicle.getAcceleration("car"), libsumo.vehicle.getSpeed("car")


def begin(folder: Path, types: Path, dt: float, placed: Mapping[str, float], speed: float) -> None:
    """A simulation with these vehicles, each of the type of its own name, at these positions [m] and at one speed."""
    net, routes = folder / "net.xml", folder / "routes.xml"
    net.write_text(_NET)
    routes.write_text(_ROUTES)
    given = ["-n", str(net), "-r", str(routes), "-a", str(types), "--step-length", str(dt)]
    libsumo.close()
    libsumo.start(["sumo", *given, "--step-method.ballistic", "true", "--no-step-log", "true"])
    for name, at in placed.items():
        libsumo.vehicle.add(name, "straight", name, departPos=str(at), departSpeed=repr(float(speed)))
        libsumo.vehicle.setSpeedMode(name, _LIMITS_ONLY)
        libsumo.simulationStep()  # a step each: two are not put on one lane at once


def followed(
    folder: Path, types: Path, law: Law, *, own_model: bool = False, swing: float = 1.0, seconds: float, dt: float = 0.1
) -> Log:
    """The car behind a leader whose acceleration swings by 2.4 m/s², times `swing`.

    Its command is what `law` says of gap [m], speed and leader's speed [m/s]. With its `own_model` SUMO drives it by
    itself, and the command is what it should wish by the law.
    """
    begin(folder, types, dt, {"leader": 1030.0 + _LENGTH_M, "car": 1000.0}, 20.0)
    if own_model:
        libsumo.vehicle.setSpeedMode("car", 31)
    of, rows = libsumo.vehicle, []
    for row in range(round(seconds / dt)):
        time = row * dt
        wave = 0.9 * np.sin(0.5 * time) + 0.9 * np.sin(1.3 * time) + 0.6 * np.sin(2.3 * time)
        of.setAcceleration("leader", swing * wave, dt)
        gap = of.getLanePosition("leader") - of.getLanePosition("car") - _LENGTH_M
        speed, lead = of.getSpeed("car"), of.getSpeed("leader")
        command = law(gap, speed, lead)
        rows.append((time, command, of.getAcceleration("car"), speed, gap, lead))
        if not own_model:
            of.setAcceleration("car", command, dt)
        libsumo.simulationStep()
    names = ("time", "accel_cmd", "accel", "speed", "spacing", "lead_speed")
    return Log.from_arrays(name="sumo", **dict(zip(names, np.array(rows).T, strict=True)))
