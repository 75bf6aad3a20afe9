"""The script within an exported FMU: a plant, or its effects around another simulator, as variables of FMI.

`pythonfmu` puts it into the FMU beside `plant.toml` and `block.json`, and runs it there, in the interpreter of the
machine that imports the FMU. It is no part of what `avtorch` imports.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import torch
from pythonfmu import (  # pyright: ignore[reportMissingImports]
    DefaultExperiment,
    Fmi2Causality,
    Fmi2Initial,
    Fmi2Slave,
    Fmi2Variability,
    Integer,
    Real,
)

from avtorch.gap import GapPlant
from avtorch.gap.simulator.around import Around

_BASE = {"m/s2": {"m": "1", "s": "-2"}, "m/s": {"m": "1", "s": "-1"}, "s": {"s": "1"}, "m": {"m": "1"}}


class AvtorchBlock(Fmi2Slave):
    """Inputs, outputs and parameters of a block."""

    author = "avtorch"

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        folder = Path(str(self.resources))
        block = json.loads((folder / "block.json").read_text(encoding="utf-8"))
        self._plant = GapPlant.from_toml((folder / "plant.toml").read_text(encoding="utf-8"))
        self._dt: float | None = block["dt"]
        self.modelName, self.description = block["name"], block["description"]
        if self._dt is not None:
            self.default_experiment = DefaultExperiment(step_size=self._dt)
        self._units: dict[str, str] = {}
        self._values: dict[str, Any] = {}  # of inputs and parameters
        self._around: Around | None = None
        self._car: tuple[torch.Tensor, torch.Tensor] | None = None
        self._add("accel_cmd", "m/s2", "input")
        if self._dt is None:
            self._add("accel", "m/s2", "output", lambda: float(self._started()[0]))
            self._add("speed", "m/s", "output", lambda: float(self._started()[1]))
            self._add("speed0", "m/s", "parameter")
            self._add("accel0", "m/s2", "parameter")
        else:
            self._add("accel_sim", "m/s2", "input")
            self._add("speed_sim", "m/s", "input")
            self._add("accel_cmd_out", "m/s2", "output", lambda: self._outside().command(*self._inputs()))
            self._add("accel", "m/s2", "output", lambda: self._outside().car(*self._inputs())[0])
            self._add("speed", "m/s", "output", lambda: self._outside().car(*self._inputs())[1])
        coordinates = self._plant.parameters()
        self._own = [
            name
            for name, value in self._plant.values().items()
            if value.numel() == 1 and (self._dt is None or name not in ("T_L", "K_L"))
        ]
        for name in self._own:
            unit = coordinates[name].unit if name in coordinates else "-"
            unit = unit.replace("²", "2").replace("³", "3")
            self._add(name, unit, "parameter", value=float(self._plant.values()[name]))
        self._add("seed", "-", "parameter", value=0)

    def _add(
        self, name: str, unit: str, causality: str, getter: Callable[[], float] | None = None, value: float = 0.0
    ) -> None:
        self._units[name] = unit
        more: dict[str, Any] = {"getter": getter}
        if getter is None:
            self._values[name] = value
            more = {"getter": lambda: self._values[name], "setter": lambda x: self._values.__setitem__(name, x)}
        if causality == "parameter":
            more |= {"variability": Fmi2Variability.fixed, "initial": Fmi2Initial.exact}
        kind = Integer if isinstance(value, int) else Real
        self.register_variable(kind(name, causality=getattr(Fmi2Causality, causality), **more), nested=False)

    def to_xml(self, model_options: Any = ()) -> Element:
        """The model description, with what pythonfmu leaves out."""
        options: dict[str, Any] = {"canHandleVariableCommunicationStepSize": self._dt is None, **dict(model_options)}
        root = super().to_xml(options)
        definitions = Element("UnitDefinitions")
        for name, powers in _BASE.items():
            SubElement(SubElement(definitions, "Unit", name=name), "BaseUnit", powers)
        root.insert(1, definitions)
        for variable in root.iter("ScalarVariable"):
            name = variable.attrib["name"]
            if name in self._own:
                variable[0].set("start", repr(self._values[name]))  # 16 digits do not hold every number
            unit = self._units.get(name)
            if unit in _BASE:
                variable[0].set("unit", unit)
        structure = root.find("ModelStructure")
        if structure is not None:  # what an initialised FMU computes: all outputs, which pythonfmu does not list
            unknowns = SubElement(structure, "InitialUnknowns")
            unknowns.extend(Element("Unknown", output.attrib) for output in structure.iterfind("Outputs/Unknown"))
        return root

    # drives --------------------------------------------------------------------------------------------------------
    def exit_initialization_mode(self) -> None:
        """Take the parameters as they are now."""
        plant = self._plant.with_values({k: torch.tensor(self._values[k], dtype=torch.float64) for k in self._own})
        self._run = GapPlant(plant.effects, T_L=plant.T_L, K_L=plant.K_L, sigma=plant.sigma, seed=self._values["seed"])
        if self._dt is None:
            self._car = self._started()
        else:
            self._around = Around(self._run, self._dt)

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Go on to the next communication point."""
        if self._dt is not None:
            if abs(step_size - self._dt) > 1e-9 * self._dt:
                raise ValueError(f"step size: found {step_size!r} s, needs {self._dt!r} s")
            self._outside().advance(*self._inputs())
            return True
        command = torch.tensor(self._values["accel_cmd"], dtype=torch.float64)
        accel, speed, _ = self._run.step(*self._started(), command, step_size, torch.zeros_like(command))
        self._car = accel, speed.clamp_min(0.0)  # a car does not roll back
        return True

    def _started(self) -> tuple[torch.Tensor, torch.Tensor]:
        if self._car is not None:
            return self._car
        return tuple(torch.tensor(self._values[name], dtype=torch.float64) for name in ("accel0", "speed0"))  # pyright: ignore[reportReturnType]

    def _inputs(self) -> tuple[float, float, float]:
        return self._values["accel_cmd"], self._values["accel_sim"], self._values["speed_sim"]

    def _outside(self) -> Around:
        if self._around is None:
            self._around = Around(self._plant, self._dt or 0.0)
        return self._around
