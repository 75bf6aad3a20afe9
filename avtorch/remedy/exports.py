"""The repaired plant in the parameters of other tools, as far as these can express it.

- Autoware's planning simulator (`simple_planning_simulator`, model `DELAY_STEER_ACC_GEARED_WO_FALL_GUARD` and its
  kin): `acc_time_delay` [s], `acc_time_constant` [s], `vel_rate_lim` [m/s²], `acc_scaling_factor` of the debug model
- where the plant has a free form, `acceleration_map_path` of its model `DELAY_STEER_MAP_ACC_GEARED`: a table of the
  acceleration that follows a command (rows) at a speed (columns)
- openpilot (`CarParams`): `longitudinalActuatorDelay` [s], from command to response, lag and all
- SUMO's `vType` (`sumo.py`) and the pedals of CARLA (`carla.py`)
"""

from __future__ import annotations

import math
from os import PathLike
from pathlib import Path

import torch

from avtorch.gap import FREE_FORMS, ForceTable, GapPlant, ResistanceCurve
from avtorch.io import answer_set, atomic
from avtorch.pedals import PedalMap
from avtorch.remedy.carla import to_carla
from avtorch.remedy.exported import OVERSHOOT, Exported, delay_of, delays_of, gain_lost, not_exported, overshoots
from avtorch.remedy.sumo import to_sumo

ACCELERATION_MAP = "plant.autoware.csv"
FILES = ("plant.autoware.yaml", "plant.openpilot.yaml", "plant.sumo.xml", "plant.carla.yaml", ACCELERATION_MAP)
"""Every file of an export.

Example:
    >>> from avtorch.remedy.exports import FILES
    >>> [name.split(".")[1] for name in FILES]
    ['autoware', 'openpilot', 'sumo', 'carla', 'autoware']
"""

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
        "acc_time_delay": delay_of(plant),
        "acc_time_constant": float(plant.T_L),
        "debug_acc_scaling_factor": float(plant.K_L),
    }
    bounds = [x for e in plant.effects for x in e.accel_limits() or () if math.isfinite(x)]
    if bounds:
        values["vel_rate_lim"] = max(abs(x) for x in bounds)
    limiting = [e.name for e in plant.effects if e.accel_limits() is not None]
    lost = [f"{name}: limits that differ for driving and braking; the tool's one is the wider" for name in limiting]
    lost += [f"{e.name}: {OVERSHOOT}" for e in plant.effects if overshoots(e)]
    partly = [*limiting, *delays_of(plant), *(e.name for e in plant.effects if overshoots(e))]
    tool = "Autoware planning simulator"
    if acceleration_map(plant) is not None:
        tool += f", vehicle_model_type DELAY_STEER_MAP_ACC_GEARED with acceleration_map_path {ACCELERATION_MAP}"
        values["debug_acc_scaling_factor"] = 1.0  # the gain is in the map
        partly += [kind.name for kind in FREE_FORMS]
    return Exported(tool, values, (*lost, *not_exported(plant, partly)))


def acceleration_map(plant: GapPlant) -> str | None:
    """The plant's free form as Autoware's table: accelerations [m/s²] that follow commands (rows) [m/s²] at speeds
    (columns) [m/s], the gain and the resistance among them; None where it has none.

    Example:
        >>> from avtorch.gap import ForceTable, plant
        >>> from avtorch.remedy.exports import acceleration_map
        >>> print(acceleration_map(plant([ForceTable((0.0, 2.0), (0.0, 30.0), ((0.0, 0.0), (0.0, -1.0)))])), end="")
        default,0,30
        0,0,0
        2,2,1
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
    delay = delay_of(plant) + float(plant.T_L)
    lost = gain_lost(plant, "a gain is learned on the way")
    return Exported(
        "openpilot CarParams", {"longitudinalActuatorDelay": delay}, (*lost, *not_exported(plant, delays_of(plant)))
    )


def write_exports(plant: GapPlant | None, folder: str | PathLike[str], *, pedals: PedalMap | None = None) -> list[Path]:
    """Publish the `FILES` of a plant together; returns those written. Those that are not written go.

    Without a `plant` there is none but CARLA's, without a map of `pedals` all but CARLA's.

    Raises `InputError` where the folder cannot be written.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import write_exports
        >>> [path.name for path in write_exports(plant(baseline="dead_time=0.2"), "out")]
        ['plant.autoware.yaml', 'plant.openpilot.yaml', 'plant.sumo.xml']
    """
    made = [None] * 3 if plant is None else [to_autoware(plant), to_openpilot(plant), to_sumo(plant)]
    exports = [*made, None if pedals is None else to_carla(pedals, plant)]
    texts = [None if x is None else x.to_text() for x in exports]
    texts.append(None if plant is None else acceleration_map(plant))
    there = {name: text for name, text in zip(FILES, texts, strict=True) if text is not None}
    with answer_set(folder, FILES) as staged:
        for name, text in there.items():
            with atomic(staged / name) as stream:
                stream.write(text)
    return [Path(folder) / name for name in there]
