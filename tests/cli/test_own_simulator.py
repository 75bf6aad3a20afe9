"""A simulator of the user's on the command line: its output, columns of the log, an object; and what it is."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from avtorch.cli import main
from tests.external.cars import drive

CAR = """
import numpy as np

class Car:
    lag = 0.4

    def reset(self, *, speed, accel):
        self.speed, self.accel, self.late = speed, accel, [accel] * 10

    def step(self, accel_cmd, dt):
        self.late.append(accel_cmd)
        before, u = self.accel, self.late.pop(0)
        self.accel = u + np.exp(-dt / self.lag) * (before - u)
        self.speed += dt * (before + self.accel) / 2
        return self.accel, self.speed
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """real.csv, sim.csv, and both.csv, with the output in columns `sim.accel` and `sim.speed`."""
    folder = tmp_path_factory.mktemp("simulator")
    car, simulated = drive(12, more={"sensor_bias": {"bias_mps2": 0.2}}, seconds=60.0)
    car.write(folder / "real.csv")
    simulated.write(folder / "sim.csv")
    (folder / "my_car.py").write_text(CAR)
    with (folder / "both.csv").open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", "accel_cmd", "accel", "speed", "sim.accel", "sim.speed"])
        rows = (car.time, car.accel_cmd, car.accel, car.speed, simulated.accel, simulated.speed)
        writer.writerows(zip(*(x.tolist() for x in rows), strict=True))
    return folder


def diagnosed(folder: Path, out: Path, *arguments: str) -> dict:
    few = ["--effects", "sensor_bias,dead_time", "--no-pairs", "--posterior", "laplace", "--quiet"]
    assert main(["diagnose", *arguments, *few, "--out", str(out)]) == 0
    return json.loads((out / "diagnosis.json").read_text())


@pytest.mark.slow
def test_output_beside_the_log_and_in_its_columns_say_the_same(files: Path, tmp_path: Path) -> None:
    one = diagnosed(files, tmp_path / "one", str(files / "real.csv"), "--simulated", str(files / "sim.csv"))
    assert one["verdict"]["names"] == ["sensor_bias"]
    assert one["simulator"]["missing"] == ["sensor_bias"]
    assert one["simulator"]["source"] == "output"
    page = (tmp_path / "one" / "report.html").read_text()
    assert "Of the simulator itself (sim.csv)" in page
    other = diagnosed(files, tmp_path / "other", str(files / "both.csv"), "--simulated", "sim.")
    assert other["verdict"]["names"] == one["verdict"]["names"]
    assert other["effects"][0]["parameters"] == one["effects"][0]["parameters"]


@pytest.mark.slow
def test_is_it_what_i_set(files: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulator = f"{files / 'my_car.py'}:Car"
    assert main(["check-simulator", simulator, "--T", "0.4", "--delay", "0.1"]) == 0
    said = capsys.readouterr().out
    assert "T_L: 0.4 set, 0.4 obtained, as set" in said
    assert "dead_time.delay_s: 0.1 set, 0.2 obtained, not as set" in said  # ten steps of 20 ms


REFUSED = [
    (["--simulator", "no_such_module:Car"], "--simulator: no_such_module could not be imported"),
    (["--simulator", "my_car"], "--simulator: found 'my_car', needs MODULE:NAME"),
    (["--simulated", "none."], "'none.': no such file, and"),
    (["--simulated", "my_car.py:Car"], "--simulated 'my_car.py:Car': is a simulator itself; needs --simulator"),
    (["--baseline", "my_car.fmu"], "--baseline 'my_car.fmu': is a simulator itself; needs --simulator"),
    (["--simulated", "a.csv", "--simulated", "b.csv"], "found 2 files for 1 logs"),
    (["--simulated", "sim.csv", "--simulator", "my_car:Car"], "--simulated, --simulator: found both"),
    (["--simulated", "sim.csv", "--baseline", "dead_time=0.2"], "--baseline: found beside"),
    (["--step", "0.01"], "--step: has a meaning with --simulator only"),
]


@pytest.mark.parametrize(("arguments", "told"), REFUSED, ids=lambda x: x if isinstance(x, str) else None)
def test_what_cannot_be_is_refused_in_one_line(
    files: Path, tmp_path: Path, refused: Callable[[list[str]], str], arguments: list[str], told: str
) -> None:
    assert told in refused(["diagnose", str(files / "real.csv"), *arguments, "--out", str(tmp_path / "out")])


@pytest.mark.slow
def test_its_own_parameters_are_fitted_to_the_car(files: Path, tmp_path: Path) -> None:
    """An object whose lag is wrong by its own name: the car has 0.3 s behind a second-order actuator of 6 rad/s."""
    given = [str(files / "real.csv"), "--simulator", f"{files / 'my_car.py'}:Car", "--adjust", "lag=0.05:1.5"]
    found = diagnosed(files, tmp_path / "out", *given, "--rollouts", "12")["simulator"]
    own = [p for p in found["parameters"] if p["own"]]
    assert [p["name"] for p in own] == ["lag"]
    assert own[0]["simulator"] == 0.4
    assert found["rollouts"] <= 12


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--adjust", "lag"], "--adjust: found 'lag', needs NAME=LOW:HIGH, such as lag=0.1:1.0"),
        (["--adjust", "lag=0.1:x"], "--adjust: found 'lag=0.1:x', needs NAME=LOW:HIGH, such as lag=0.1:1.0"),
        (["--adjust", "mass=1:2"], "--adjust: found 'mass', needs one of lag"),
        (
            ["--adjust", "lag=1:0.1"],
            "--adjust lag: found limits 1 and 0.1, needs two finite numbers that rise",
        ),
        (["--adjust", "lag=0.5:1"], "--adjust lag: is 0.4, needs limits that hold it, found 0.5 to 1"),
        (["--adjust", "lag=0.1:1", "--rollouts", "2"], "--rollouts: found 2, needs 4 or more to adjust lag"),
        (["--rollouts", "9"], "--rollouts: has a meaning with --adjust only"),
    ],
)
def test_what_cannot_be_adjusted_is_told(
    files: Path, tmp_path: Path, refused: Callable[[list[str]], str], given: list[str], said: str
) -> None:
    simulator = ["--simulator", f"{files / 'my_car.py'}:Car"]
    assert said in refused(["diagnose", str(files / "real.csv"), *simulator, *given, "--out", str(tmp_path / "out")])
