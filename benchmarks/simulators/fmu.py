"""A stepped vehicle as an FMU (FMI 2, co-simulation), which PythonFMU runs in this interpreter."""

from __future__ import annotations

import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from pythonfmu.builder import FmuBuilder  # pyright: ignore[reportMissingImports]

from benchmarks.simulators.vehicle import SteppedVehicle

_SCRIPT = """
import json
from pathlib import Path

from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

from benchmarks.blindtest import Car
from benchmarks.simulators.vehicle import SteppedVehicle


class ReferenceVehicle(Fmi2Slave):
    accel_cmd = accel = speed = accel0 = speed0 = 0.0

    def __init__(self, **given):
        super().__init__(**given)
        made = json.loads(Path(str(self.resources), "vehicle.json").read_text())
        self.vehicle = SteppedVehicle(Car(**made["car"]), made["effects"])
        self.default_experiment = DefaultExperiment(step_size=made["step"])
        self.register_variable(Real("accel_cmd", causality=Fmi2Causality.input))
        for name in ("accel", "speed"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        fixed = {"variability": Fmi2Variability.fixed, "initial": Fmi2Initial.exact}
        for name in ("accel0", "speed0"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, **fixed))

    def exit_initialization_mode(self):
        self.accel, self.speed = self.accel0, self.speed0
        self.vehicle.reset(speed=self.speed0, accel=self.accel0)

    def do_step(self, time, dt):
        self.accel, self.speed = self.vehicle.step(self.accel_cmd, dt)
        return True
"""


def write_fmu(vehicle: SteppedVehicle, path: Path, step: float) -> Path:
    """Write the vehicle, with a communication step [s]."""
    with tempfile.TemporaryDirectory() as folder:
        script, made = Path(folder, "reference_vehicle.py"), Path(folder, "vehicle.json")
        script.write_text(_SCRIPT, encoding="utf-8")
        content = {"car": asdict(vehicle.car), "effects": vehicle.effects, "step": step}
        made.write_text(json.dumps(content), encoding="utf-8")
        before = list(sys.path)
        try:  # the builder imports the script, and leaves its folder on the path
            FmuBuilder.build_FMU(script, dest=path, project_files=[made])
        finally:
            sys.path[:] = before
            sys.modules.pop(script.stem, None)
    return path
