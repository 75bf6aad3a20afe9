"""The repaired plant as a `vType` of SUMO.

What there is: `accel` and `decel` [m/s²], the limits of acceleration and of braking that every car-following model and
every command by TraCI keeps to (`emergencyDecel`: the limit in an emergency); and a lag, `tauEngine` [s], which acts in
one model alone, `CC` of Plexe, under its controllers. Under all others, and under TraCI's `setAcceleration`, a car has
the acceleration that was asked for at the next step.

`actionStepLength` is no lag and no delay: it is the time between two decisions of the driver model, in which the last
one is held, and commands by TraCI are not held at all. `tau` is a time gap, `startupDelay` a driver's at a stop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

from avtorch.gap import GapPlant
from avtorch.remedy.exported import OVERSHOOT, Exported, delays_of, gain_lost, not_exported, overshoots

_NO_DELAY = "SUMO has no delay; actionStepLength is the time between two decisions of the driver model"
_ELSEWHERE = "of Plexe's model CC alone; every other model and TraCI answer at the next step"
_OWN = "no limit was found, so SUMO's default limits the car"


@dataclass(frozen=True)
class SumoType(Exported):
    """A `vType`, in a file of additional elements.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_sumo
        >>> to_sumo(plant(T_L=0.4)).to_text().splitlines()[-2]
        '    <vType id="car" carFollowModel="CC" lanesCount="1" tauEngine="0.4" />'
    """

    def to_text(self) -> str:
        """XML, with the lost properties as comments."""
        root = ElementTree.Element("additional")
        for text in (self.tool, *(f"not expressed: {x}" for x in self.lost)):
            root.append(ElementTree.Comment(f" {text} "))
        # the model CC asks for the number of lanes
        given = {"id": "car", "carFollowModel": "CC", "lanesCount": "1"}
        ElementTree.SubElement(root, "vType", given | {k: f"{x:.6g}" for k, x in self.values.items()})
        ElementTree.indent(root, "    ")
        return ElementTree.tostring(root, encoding="unicode") + "\n"


def to_sumo(plant: GapPlant) -> SumoType:
    """Lag and limits of `plant`.

    Example:
        >>> from avtorch.gap import Saturation, plant
        >>> from avtorch.remedy import to_sumo
        >>> exported = to_sumo(plant([Saturation(1.5, -3.0)], baseline="dead_time=0.2", T_L=0.4))
        >>> dict(exported.values)
        {'tauEngine': 0.4, 'accel': 1.5, 'decel': 3.0, 'emergencyDecel': 3.0}
        >>> [text.partition(":")[0] for text in exported.lost]
        ['tauEngine', 'dead_time']
    """
    limits = [x for e in plant.effects if (x := e.accel_limits()) is not None]
    most = min((high for _, high in limits), default=math.inf)
    brake = min((-low for low, _ in limits), default=math.inf)
    values = {"tauEngine": float(plant.T_L)}
    lost = [f"tauEngine: {_ELSEWHERE}"]
    if math.isfinite(most):
        values["accel"] = most
    else:
        lost.append(f"accel: {_OWN}")
    if math.isfinite(brake):
        values |= {"decel": brake, "emergencyDecel": brake}
    else:
        lost.append(f"decel: {_OWN}")
    lost += gain_lost(plant, "a car does what it is asked to, as far as its limits allow")
    lost += [f"{name}: {_NO_DELAY}" for name in delays_of(plant)]
    lost += [f"{e.name}: {OVERSHOOT}" for e in plant.effects if overshoots(e)]
    held = [e.name for e in plant.effects if e.accel_limits() is not None or overshoots(e)]
    return SumoType("SUMO vType", values, (*lost, *not_exported(plant, [*held, *delays_of(plant)])))
