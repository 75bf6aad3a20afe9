"""`avtorch compare`: its output and files, and one line for input that it cannot use."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.cli import main
from avtorch.external import write_fmu
from avtorch.gap import plant
from tests.cli.test_own_simulator import CAR
from tests.gap.records import log_of


@pytest.mark.slow
def test_it_says_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = tmp_path / "one.csv", tmp_path / "two.csv"
    log_of(plant(T_L=0.3, K_L=1.0), seconds=60.0).write(one)
    log_of(plant(T_L=0.6, K_L=0.7), seconds=60.0).write(two)
    assert main(["compare", str(one), str(two), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "has changed" in said
    assert "lag T_L [s]" in said
    told = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert told["schema"] == "avtorch.comparison/1"
    assert told["changed"] is True
    assert main(["compare", str(one), str(one), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["changed"] is False


@pytest.mark.slow
def test_several_drives_a_side_are_compared_as_in_python(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [tmp_path / f"{name}.csv" for name in ("a1", "a2", "b1", "b2")]
    for i, path in enumerate(files):
        log_of(plant(T_L=0.3 if i < 2 else 0.6), seconds=30.0, rng=np.random.default_rng(i)).write(path)
    names = [*map(str, files)]
    assert main(["compare", *names[:2], "--after", *names[2:], "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [told[side]["segments"] for side in ("before", "after")] == [2, 2]
    assert told == json.loads(json.dumps(avtorch.compare(names[:2], names[2:]).to_dict()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A car's log, and simulators of every kind: an object and an FMU of the car, an output and columns that lag."""
    folder = tmp_path_factory.mktemp("two")
    car = log_of(plant(baseline="dead_time=0.5", T_L=0.4), seconds=40.0)
    car.write(folder / "real.csv")
    simulated = log_of(plant(T_L=0.4), seconds=40.0, noise=None)
    simulated.write(folder / "sim.csv")
    (folder / "my_car.py").write_text(CAR)  # ten steps late, of 0.05 s
    write_fmu(plant(baseline="dead_time=0.5", T_L=0.4), folder / "car.fmu")
    return folder


MIXES = {
    "output, object": (
        ["--simulator", "{}/my_car.py:Car", "--simulated", "{}/sim.csv"],
        "first",
        "simulator",
        "output",
    ),
    "plant, FMU": (["--simulator", "T_L=0.4", "--simulator", "{}/car.fmu"], "second", "plant", "simulator"),
    "own, FMU": (["--simulator", "{}/my_car.py:Car", "--simulator", "{}/car.fmu"], None, "simulator", "simulator"),
}


@pytest.mark.parametrize(
    "mix", [m if m == "output, object" else pytest.param(m, marks=pytest.mark.slow) for m in MIXES]
)
def test_two_simulators_of_any_kind(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], mix: str) -> None:
    given, nearer, *sources = MIXES[mix]
    arguments = [x.format(folder) for x in given]
    assert main(["compare", str(folder / "real.csv"), *arguments, "--out", str(tmp_path)]) == 0
    told = json.loads((tmp_path / "comparison.json").read_text())
    assert told["schema"] == "avtorch.simulators/1"
    assert told["nearer"] == nearer
    assert [told[which]["source"] for which in ("first", "second")] == sources
    said = " ".join(capsys.readouterr().out.split())
    if nearer is None:
        assert "cannot tell which simulator is nearer" in said
        assert told["differences"] == []
    else:
        assert "is nearer to the car" in said
        assert [d["name"] for d in told["differences"]] == ["dead_time"]
        assert told["differences"][0]["ratio"]["q95"] < 1
        assert "error of the farther (90 %)" in said


def test_two_simulators_in_one_line_of_json(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    two = ["--simulator", "T_L=0.4", "--simulator", "dead_time=0.5, T_L=0.4"]
    assert main(["compare", str(folder / "real.csv"), *two, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["nearer"] == "second"


REFUSED = [
    (["--simulator", "T_L=0.4"], "found 1 beside one log, needs two"),
    (["--simulator", "T_L=0.4", "--simulator", "glvd"], "--simulator: found glvd, which would be fitted to the log"),
    (["--simulator", "T_L=0.4", "--simulator", "no.toml"], "--simulator 'no.toml': no such file"),
    (["--simulator", "T_L=0.4", "--simulator", "no_such:Car"], "--simulator: no_such could not be imported"),
    (["--simulator", "T_L=0.4", "--simulated", "none."], "'none.': no such file, and"),
    (["--simulator", "T_L=0.4", "--simulator", "K_L=0.9", "--step", "0.1"], "--step: has a meaning with an object"),
    (["--simulator", "T_L=0.4", "--simulator", "K_L=0.9", "--baseline", "T_L=0.2"], "--baseline: found beside"),
    (["{}/real.csv", "--simulator", "T_L=0.4", "--simulator", "T_L=0.5"], "found 2 beside several logs, needs one"),
    (["{}/real.csv", "--simulator", "my_car:Car", "--baseline", "T_L=0.2"], "--baseline: found beside"),
    (["{}/real.csv", "--simulator", "T_L=0.4"], "found 'T_L=0.4', needs MODULE:NAME"),
    (["{}/real.csv", "--simulated", "{}/sim.csv"], "--simulated: found 1 files for 2 logs"),
    (["{}/real.csv", "--step", "0.1"], "--step: has a meaning with --simulator only"),
]


@pytest.mark.parametrize(("arguments", "told"), REFUSED, ids=lambda x: x if isinstance(x, str) else None)
def test_what_is_no_pair_of_simulators_is_refused(
    folder: Path, refused: Callable[[list[str]], str], arguments: list[str], told: str
) -> None:
    assert told in refused(["compare", str(folder / "real.csv"), *(x.format(folder) for x in arguments)])


def test_what_it_cannot_use(tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    one = tmp_path / "one.csv"
    log_of(seconds=60.0).write(one)
    for arguments, told in (
        ([str(one), str(tmp_path / "none.csv")], "none.csv"),
        ([str(one)] * 3, "LOGS: found 3, needs two; with more, say --after"),
        ([str(one), str(one), "--baseline", "no_such=1"], "--baseline"),
        ([str(one), str(one), "--baseline-after", "dead_time=0.1"], "--baseline-after"),
    ):
        assert told in refused(["compare", *arguments])
