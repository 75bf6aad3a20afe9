"""The repaired plant in the parameters of other tools, as far as these can express it.

- Autoware's planning simulator (`simple_planning_simulator`, model `DELAY_STEER_ACC_GEARED_WO_FALL_GUARD` and its
  kin): `acc_time_delay` [s], `acc_time_constant` [s], `vel_rate_lim` [m/s²], `acc_scaling_factor` of the debug model
- openpilot (`CarParams`): `longitudinalActuatorDelay` [s], from command to response, lag and all
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from avtorch.gap import GapPlant
from avtorch.io import answer_set, atomic


@dataclass(frozen=True)
class Exported:
    """`values` by the tool's own names; `lost`: properties of the plant that the tool cannot express, one sentence
    each.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_autoware
        >>> exported = to_autoware(plant(baseline="sensor_bias=0.1"))
        >>> exported.tool, sorted(exported.values), len(exported.lost)
        ('Autoware planning simulator', ['acc_time_constant', 'acc_time_delay', 'debug_acc_scaling_factor'], 1)
    """

    tool: str
    values: Mapping[str, float]
    lost: tuple[str, ...]

    def to_text(self) -> str:
        """YAML lines, with the lost properties as comments."""
        lines = [f"# {self.tool}", *(f"# not expressed: {text}" for text in self.lost)]
        return "\n".join([*lines, *(f"{name}: {value:.6g}" for name, value in self.values.items())]) + "\n"


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
    limits = [limit for e in plant.effects if (limit := e.accel_limit()) is not None]
    if limits:
        values["vel_rate_lim"] = min(limits)
    partly = [e for e in plant.effects if e.export_loss]
    lost = [f"{e.name}: {e.export_loss}" for e in partly]
    return Exported("Autoware planning simulator", values, (*lost, *_not_exported(plant, {e.name for e in partly})))


def to_openpilot(plant: GapPlant) -> Exported:
    """The actuator's delay as openpilot means it: until the response to a step has gone 63 % of its way.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_openpilot
        >>> {k: round(v, 2) for k, v in to_openpilot(plant(baseline="dead_time=0.2", T_L=0.4)).values.items()}
        {'longitudinalActuatorDelay': 0.6}
    """
    delay = _delay(plant) + float(plant.T_L)
    lost = [f"K_L {float(plant.K_L):.3g}: a gain is learned on the way"] if abs(float(plant.K_L) - 1) > 0.01 else []
    return Exported("openpilot CarParams", {"longitudinalActuatorDelay": delay}, (*lost, *_not_exported(plant)))


def write_exports(plant: GapPlant | None, folder: str | PathLike[str]) -> list[Path]:
    """Publish `plant.autoware.yaml` and `plant.openpilot.yaml` together; returns the files. None: earlier ones go.

    Raises `InputError` where the folder cannot be written.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import write_exports
        >>> [path.name for path in write_exports(plant(baseline="dead_time=0.2"), "out")]
        ['plant.autoware.yaml', 'plant.openpilot.yaml']
    """
    tools = {"plant.autoware.yaml": to_autoware, "plant.openpilot.yaml": to_openpilot}
    with answer_set(folder, list(tools)) as staged:
        for name, export in tools.items():
            if plant is not None:
                with atomic(staged / name) as stream:
                    stream.write(export(plant).to_text())
    return [] if plant is None else [Path(folder) / name for name in tools]


def _delay(plant: GapPlant) -> float:
    """Total delay [s] that all effects add to the command."""
    return sum((float(getattr(e, e.shift)) for e in plant.effects if e.shift is not None), 0.0)


def _not_exported(plant: GapPlant, reported: Collection[str] = ()) -> tuple[str, ...]:
    lost = []
    for e in plant.effects:
        if e.name in reported or e.shift is not None:
            continue
        where = "the sensor's, not the car's" if e.place == "sensor" else e.meaning
        lost.append(f"{e.name}: {where}")
    return tuple(lost)
