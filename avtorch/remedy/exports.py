"""The repaired plant in the parameters of other tools, as far as these can express it.

- Autoware's planning simulator (`simple_planning_simulator`, model `DELAY_STEER_ACC_GEARED_WO_FALL_GUARD` and its
  kin): `acc_time_delay` [s], `acc_time_constant` [s], `vel_rate_lim` [m/s²], `acc_scaling_factor` of the debug model
- where the plant has a free form, `acceleration_map_path` of its model `DELAY_STEER_MAP_ACC_GEARED`: a table of the
  acceleration that follows a command (rows) at a speed (columns)
- openpilot (`CarParams`): `longitudinalActuatorDelay` [s], from command to response, lag and all
- SUMO's `vType`: `accel` and `decel` [m/s²], the limits of acceleration and of braking that every car-following model
  and every command by TraCI keeps to (`emergencyDecel`: the limit in an emergency); and a lag, `tauEngine` [s], which
  acts in one model alone, `CC` of Plexe, under its controllers. Under all others, and under TraCI's `setAcceleration`,
  a car has the acceleration that was asked for at the next step. `actionStepLength` is no lag and no delay: it is the
  time between two decisions of the driver model, in which the last one is held, and commands by TraCI are not held at
  all. `tau` is a time gap, `startupDelay` a driver's at a stop.
- the pedals of CARLA's `VehicleControl`, throttle and brake from 0 to 1. CARLA's cars read no such table: what their
  pedals do comes from a torque curve, gears, mass, drag and tyres (`VehiclePhysicsControl`), of which a log tells none
  by itself. So the table says what the real car does; a controller that drives the model needs the same table of the
  model, as `avtorch` makes it from a drive in CARLA.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from xml.etree import ElementTree

import torch

from avtorch.arrays import FloatArray
from avtorch.gap import FREE_FORMS, ForceTable, GapPlant, ResistanceCurve
from avtorch.io import answer_set, atomic
from avtorch.pedals import MapTable, PedalMap, accel_table, brake_table


@dataclass(frozen=True)
class Exported:
    """`values` by the tool's own names; `lost`: properties of the plant that the tool cannot express, one sentence
    each; `tables` of the acceleration by the name of a pedal.
    """

    tool: str
    values: Mapping[str, float]
    lost: tuple[str, ...]
    tables: Mapping[str, MapTable] = field(default_factory=dict)

    def to_text(self) -> str:
        """YAML lines, with the lost properties as comments; for each pedal the acceleration [m/s²] by pedal (a line
        each) and speed [m/s], coasting included."""
        lines = [f"# {self.tool}", *(f"# not expressed: {text}" for text in self.lost)]
        lines += [f"{name}: {value:.6g}" for name, value in self.values.items()]
        for name, table in self.tables.items():
            lines += [f"{name}:", f"  speed: {_numbers(table.speed)}"]
            lines += [f"  {pedal:.6g}: {_numbers(row)}" for pedal, row in zip(table.pedal, table.accel, strict=True)]
        return "\n".join(lines) + "\n"


def _numbers(values: FloatArray) -> str:
    return "[" + ", ".join(f"{x:.4g}" for x in values) + "]"


def _delay(plant: GapPlant) -> float:
    """Total delay [s] that all effects add to the command."""
    return sum((float(getattr(e, e.shift)) for e in plant.effects if e.shift is not None), 0.0)


def _lost(
    plant: GapPlant, *, gain: str = "", delay: str = "", limit: str | None = None, overshoot: str | None = None
) -> list[str]:
    """A sentence on each property of `plant` that a tool does not have.

    `gain` of `K_L`, and of effects that delay commands, limit the acceleration or make the actuator overshoot: what is
    said of them; empty where the tool has it, None: what the effect means.
    """
    value = float(plant.K_L)
    found = [f"K_L {value:.3g}: {gain}"] if gain and abs(value - 1) > 0.01 else []
    for e in plant.effects:
        text = "the sensor's, not the car's" if e.place == "sensor" else e.meaning
        if e.shift is not None:
            text = delay
        elif e.accel_limits() is not None and limit is not None:
            text = limit
        elif "tau" in e.actuator_parameters() and overshoot is not None:
            text = overshoot
        if text:
            found.append(f"{e.name}: {text}")
    return found


_OVERSHOOT = "its overshoot; the time constant is that of the two poles together"
_NO_DELAY = "SUMO has no delay; actionStepLength is the time between two decisions of the driver model"
_ELSEWHERE = "of Plexe's model CC alone; every other model and TraCI answer at the next step"
_OWN = "no limit was found, so SUMO's default limits the car"


@dataclass(frozen=True)
class SumoType(Exported):
    """A `vType`, in a file of additional elements."""

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
    """Lag and limits of `plant`."""
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
    gain = "a car does what it is asked to, as far as its limits allow"
    lost += _lost(plant, gain=gain, delay=_NO_DELAY, limit="", overshoot=_OVERSHOOT)
    return SumoType("SUMO vType", values, tuple(lost))


_NO_LAG = "VehicleControl has neither; what the model has comes from its physics"
_PHYSICS = "mass, drag_coefficient and torque_curve of VehiclePhysicsControl: a log of pedals does not tell them apart"


def to_carla(pedals: PedalMap, plant: GapPlant | None = None) -> Exported:
    """The map `pedals` for throttle and brake; of the `plant`, if one was found behind them, only what is lost."""
    given = {"throttle": accel_table(pedals), "brake": brake_table(pedals)}
    tables = {name: table for name, table in given.items() if table is not None}
    lag, late = (pedals.T_L, pedals.dead_time) if plant is None else (float(plant.T_L), _delay(plant))
    lost = [f"lag {lag:.3g} s and dead time {late:.3g} s: {_NO_LAG}"]
    lost += [f"{name}: the log has none" for name, table in given.items() if table is None]
    lost += dict.fromkeys(text for table in tables.values() for text in table.lost[1:])  # the first is the lag again
    lost.append(f"physics: {_PHYSICS}")
    if plant is not None:
        lost += _lost(plant, gain="the tables hold K_L 1; multiply the accelerations")
    return Exported("CARLA VehicleControl", {}, tuple(lost), tables)


ACCELERATION_MAP = "plant.autoware.csv"
FILES = ("plant.autoware.yaml", "plant.openpilot.yaml", "plant.sumo.xml", "plant.carla.yaml", ACCELERATION_MAP)
"""Every file of an export."""

_FAR_MPS2 = 10.0  # beyond what tyres hold


def to_autoware(plant: GapPlant) -> Exported:
    """Delay, time constant, scaling and limits of `plant`.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_autoware
        >>> print(to_autoware(plant(baseline="dead_time=0.2", T_L=0.4)).to_text(), end="")
        # Autoware planning simulator
        acc_time_delay: 0.2
        acc_time_constant: 0.4
        debug_acc_scaling_factor: 1
    """
    values = {
        "acc_time_delay": _delay(plant),
        "acc_time_constant": float(plant.T_L),
        "debug_acc_scaling_factor": float(plant.K_L),
    }
    bounds = [x for e in plant.effects for x in e.accel_limits() or () if math.isfinite(x)]
    if bounds:
        values["vel_rate_lim"] = max(abs(x) for x in bounds)
    tool, others = "Autoware planning simulator", plant
    if acceleration_map(plant) is not None:
        tool += f", vehicle_model_type DELAY_STEER_MAP_ACC_GEARED with acceleration_map_path {ACCELERATION_MAP}"
        values["debug_acc_scaling_factor"] = 1.0  # the gain is in the map, as the free form is
        others = GapPlant(
            [e for e in plant.effects if not isinstance(e, FREE_FORMS)], T_L=plant.T_L, K_L=1.0, sigma=0.0
        )
    limit = "limits that differ for driving and braking; the tool's one is the wider"
    return Exported(tool, values, tuple(_lost(others, limit=limit, overshoot=_OVERSHOOT)))


def acceleration_map(plant: GapPlant) -> str | None:
    """The plant's free form as Autoware's table: accelerations [m/s²] that follow commands (rows) [m/s²] at speeds
    (columns) [m/s], the gain and the resistance among them; None where it has none.
    """
    tables = [e for e in plant.effects if isinstance(e, ForceTable)]
    curves = [e for e in plant.effects if isinstance(e, ResistanceCurve)]
    if not tables and not curves:
        return None
    speeds = tables[0].speed_mps if tables else curves[0].speed_mps
    commands = tables[0].command_mps2 if tables else (-_FAR_MPS2, _FAR_MPS2)
    lines = [",".join(["default", *(f"{v:.6g}" for v in speeds)])]
    at = torch.tensor(speeds, dtype=torch.float64)
    resists = sum((c.force(at) for c in curves), torch.zeros_like(at))
    for u in commands:
        given = torch.full_like(at, u)
        force = plant.K_L * given + resists + sum((t.force(given, at) for t in tables), torch.zeros_like(at))
        lines.append(",".join(f"{x:.6g}" for x in (u, *force.tolist())))
    return "\n".join(lines) + "\n"


def to_openpilot(plant: GapPlant) -> Exported:
    """The actuator's delay as openpilot means it: until the response to a step has gone 63 % of its way.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_openpilot
        >>> {k: round(v, 2) for k, v in to_openpilot(plant(baseline="dead_time=0.2", T_L=0.4)).values.items()}
        {'longitudinalActuatorDelay': 0.6}
    """
    delay = _delay(plant) + float(plant.T_L)
    lost = _lost(plant, gain="a gain is learned on the way")
    return Exported("openpilot CarParams", {"longitudinalActuatorDelay": delay}, tuple(lost))


def write_exports(plant: GapPlant | None, folder: str | PathLike[str], *, pedals: PedalMap | None = None) -> list[Path]:
    """Publish the `FILES` of a plant together; returns those written. Those that are not written go.

    Without a `plant` there is none but CARLA's, without a map of `pedals` all but CARLA's.

    Raises `InputError` where the folder cannot be written.
    """
    exports: dict[str, Exported] = {}
    if plant is not None:
        exports = dict(zip(FILES, (to_autoware(plant), to_openpilot(plant), to_sumo(plant)), strict=False))
    if pedals is not None:
        exports["plant.carla.yaml"] = to_carla(pedals, plant)
    there = {name: export.to_text() for name, export in exports.items()}
    if plant is not None and (table := acceleration_map(plant)) is not None:
        there[ACCELERATION_MAP] = table
    with answer_set(folder, FILES) as staged:
        for name, text in there.items():
            with atomic(staged / name) as stream:
                stream.write(text)
    return [Path(folder) / name for name in there]
