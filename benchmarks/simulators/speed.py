"""How long does a diagnosis against a slow simulator take?

``python -m benchmarks.simulators.speed --step-ms 1 --by fmu --minutes 5 [--adjust lag=0.05:1.0] [--keep FOLDER]``

The simulator spends so long on each step, besides its own sums. What the command prints is passed on. The car's log is
at 100 Hz and has a sensor bias more than the simulator.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pythonfmu.builder import FmuBuilder  # pyright: ignore[reportMissingImports]

from avtorch import Leader, simulate
from avtorch.gap import plant
from avtorch.gap.effects.sensor_bias import SensorBias

RATE_HZ = 100

_CAR = """
import time


class Car:
    step_s = 0.0

    def __init__(self, lag=0.3, gain=1.0):
        self.lag, self.gain, self.accel, self.speed = lag, gain, 0.0, 0.0

    def reset(self, speed, accel=0.0):
        self.speed, self.accel = speed, accel

    def step(self, accel_cmd, dt):
        until = time.perf_counter() + self.step_s
        before = self.accel
        self.accel += dt / (self.lag + dt) * (self.gain * accel_cmd - self.accel)
        self.speed = max(self.speed + 0.5 * dt * (before + self.accel), 0.0)
        while time.perf_counter() < until:
            pass
        return self.accel, self.speed
"""

_FMU = """
from pythonfmu import DefaultExperiment, Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Real

class SlowCar(Fmi2Slave):
    accel_cmd = accel = speed = accel0 = speed0 = 0.0
    lag, gain = 0.3, 1.0

    def __init__(self, **given):
        super().__init__(**given)
        self.default_experiment = DefaultExperiment(step_size=0.01)
        self.register_variable(Real("accel_cmd", causality=Fmi2Causality.input))
        for name in ("accel", "speed"):
            self.register_variable(Real(name, causality=Fmi2Causality.output))
        fixed = {"variability": Fmi2Variability.fixed, "initial": Fmi2Initial.exact}
        for name in ("accel0", "speed0", "lag", "gain"):
            self.register_variable(Real(name, causality=Fmi2Causality.parameter, **fixed))

    def exit_initialization_mode(self):
        self.car = Car(self.lag, self.gain)
        self.accel, self.speed = self.accel0, self.speed0
        self.car.reset(self.speed0, self.accel0)

    def do_step(self, time, dt):
        self.accel, self.speed = self.car.step(self.accel_cmd, dt)
        return True
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--step-ms", type=float, default=1.0)
    parser.add_argument("--by", choices=("object", "fmu"), default="fmu")
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--adjust", nargs="*", default=[])
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        leader = Leader.default(duration=60.0 * options.minutes, dt=1 / RATE_HZ)
        car = plant([SensorBias(0.15)])
        simulate(leader, plant=car, duration=60.0 * options.minutes).log().write(folder / "car.csv")
        source = _CAR.replace("step_s = 0.0", f"step_s = {options.step_ms / 1000}")
        (folder / "slow_car.py").write_text(source + (_FMU if options.by == "fmu" else ""), encoding="utf-8")
        simulator = "slow_car:Car"
        if options.by == "fmu":
            FmuBuilder.build_FMU(folder / "slow_car.py", dest=folder / "slow_car.fmu")
            simulator = "slow_car.fmu"
        command = [
            str(Path(sys.executable).with_name("avtorch")),
            "diagnose",
            "car.csv",
            "--simulator",
            simulator,
            "--out",
            "answer",
        ]
        for pair in options.adjust:
            command += ["--adjust", pair]
        begun = time.monotonic()
        done = subprocess.run(command, cwd=folder, check=False)
        spent = resource.getrusage(resource.RUSAGE_CHILDREN)
        print(
            f"{options.by}, {options.step_ms:g} ms a step, {options.minutes:g} min at {RATE_HZ} Hz: exit status "
            f"{done.returncode}, {time.monotonic() - begun:.0f} s, {spent.ru_utime + spent.ru_stime:.0f} processor s"
        )


if __name__ == "__main__":
    main()
