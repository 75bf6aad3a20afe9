"""FMUs as simulators: a car in C, driven as the test's own Python drives it; and what no FMU may do."""

from __future__ import annotations

import importlib.util
import re
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch import InputError
from avtorch.external import FmuSimulator, Simulator, fmu
from avtorch.external.driving import side_by_side
from avtorch.io.mapping import read_mapping
from tests.external import fmus

DT = 0.02
TIME = np.arange(100) * DT
COMMAND = np.sin(2.1 * TIME) + 0.5 * np.sign(np.sin(5.0 * TIME))
# thousands of additions of numbers of the size of the speed, 20 m/s, each rounded once in C and once in Python
CLOSE: dict[str, float] = {"rtol": 0.0, "atol": 1000 * len(TIME) * DT * 20 * 2.0**-52}


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    return {fmi: fmus.library(tmp_path_factory.mktemp(f"fmi{fmi}"), fmi) for fmi in (2, 3)}


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def fmi(request: pytest.FixtureRequest) -> int:
    return request.param


class Build:
    """Packs the car in C with a description of its own; what it opened is closed at the end."""

    def __init__(self, folder: Path, compiled: dict[int, Path]) -> None:
        self.folder, self.compiled, self.opened = folder, compiled, []

    def fmu(self, fmi: int = 2, given: dict | None = None, **other: Any) -> Path:
        xml = fmus.description(fmi, given if given is not None else fmus.variables(), **other)
        return fmus.packed(self.folder / "car.fmu", xml, self.compiled[fmi], fmus.BINARIES[fmi])

    def open(self, path: Path, **arguments: Any) -> FmuSimulator:
        arguments = {"map": {"speed0": "v0", "accel0": "a0"}, **arguments}
        self.opened.append(FmuSimulator(path, **arguments))
        return self.opened[-1]


@pytest.fixture
def build(tmp_path: Path, compiled: dict[int, Path]) -> Iterator[Build]:
    build = Build(tmp_path, compiled)
    yield build
    for simulator in build.opened:
        simulator.close()


def driven(car: FmuSimulator, dt: float = DT, **start: float) -> tuple[np.ndarray, np.ndarray]:
    return car.whole_drive(COMMAND, dt, **{"speed": 20.0, "accel": 0.4, **start})


def expected(**given: float) -> tuple[list[float], list[float]]:
    return fmus.drive(COMMAND, DT, **{"speed": 20.0, "accel": 0.4, **given})


def test_a_drive_is_the_models_own_step_by_step_and_again(build: Build, fmi: int) -> None:
    car = build.open(build.fmu(fmi))
    assert isinstance(car, Simulator)
    accel, speed = driven(car)
    np.testing.assert_allclose((accel, speed), expected(), **CLOSE)
    car.reset(speed=20.0, accel=0.4)
    steps = [car.step(u, DT) for u in COMMAND[:10].tolist()]
    assert steps == list(zip(accel[:10], speed[:10], strict=True))
    np.testing.assert_array_equal(driven(car), (accel, speed))


def test_steps_of_different_lengths(build: Build, fmi: int) -> None:
    steps = np.where(np.arange(20) % 2, 0.01, 0.05)
    accel, _ = build.open(build.fmu(fmi)).whole_drive(COMMAND[:20], steps, speed=20.0, accel=0.0)
    # each of the model's own steps is 1 ms, so that holding a command for 50 ms is holding it five times for 10 ms
    fine = np.repeat(COMMAND[:20], np.rint(steps / 0.01).astype(int))
    ends = np.cumsum(np.rint(steps / 0.01).astype(int)) - 1
    np.testing.assert_allclose(accel, np.array(fmus.drive(fine, 0.01, speed=20.0, accel=0.0)[0])[ends], **CLOSE)


# units -------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("accel", "speed"), [("gees", "km/h"), ("g", "kph")], ids=["defined", "named"])
def test_units_that_the_fmu_states_are_converted(build: Build, fmi: int, accel: str, speed: str) -> None:
    given = fmus.variables(units={"u": accel, "a": accel, "a0": accel, "v": speed, "v0": speed})
    given["accel_scale"]["start"], given["speed_scale"]["start"] = 1 / 9.80665, 3.6
    # the start of the description is what a tool shows; the model has its own, so it is told
    car = build.open(build.fmu(fmi, given)).with_parameters({"accel_scale": 1 / 9.80665, "speed_scale": 3.6})
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)


@pytest.mark.parametrize(
    ("of", "unit", "told"),
    [
        ({"units": {"v": "m/s"}}, {"speed": "km/h"}, "in km/h as given"),  # overrules the FMU's own
        ({"names": {"v": "vehicle_speed_kmh"}}, None, "in km/h by its name"),
    ],
    ids=["given", "in the name"],
)
def test_a_unit_that_the_fmu_does_not_state(build: Build, of: dict, unit: dict | None, told: str) -> None:
    car = build.open(build.fmu(given=fmus.variables(**of)), unit=unit)
    assert any(told in note for note in car.notes)
    shown = driven(car.with_parameters({"speed_scale": 3.6}), speed=0.0)[1]
    np.testing.assert_allclose(shown, expected(speed=0.0)[1], **CLOSE)


# names -------------------------------------------------------------------------------------------------------------
def ambiguous() -> dict[str, dict]:
    given = fmus.variables(names={"a": "y1", "v": "y2"}, units={"a": "m/s2", "v": "m/s", "drag": "m/s2"})
    given["drag"] |= {"causality": "output", "variability": None, "initial": None, "start": None}
    return given


def test_outputs_are_found_by_their_units(build: Build) -> None:
    given = fmus.variables(names={"a": "y1", "v": "y2"}, units={"a": "m/s2", "v": "m/s"})
    np.testing.assert_allclose(driven(build.open(build.fmu(given=given))), expected(), **CLOSE)


@pytest.mark.parametrize(("name", "unit", "how"), [("y", "m/s2", "unit"), ("accel_request", None, "name")])
def test_of_several_inputs_the_one_that_fits_is_taken(build: Build, name: str, unit: str | None, how: str) -> None:
    given = fmus.variables(names={"u": name}, units={"u": unit})
    given["drag"] |= {"causality": "input", "variability": None, "initial": None}
    car = build.open(build.fmu(given=given))
    assert any(note.startswith(f"accel_cmd: variable {name!r} (by its {how})") for note in car.notes)
    assert "inputs that keep their start values: drag" in car.notes
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)


def without_a_speed() -> dict[str, dict]:
    given = fmus.variables()
    given["v"]["causality"] = "local"
    return given


def of_pedals() -> dict[str, dict]:
    """Before, a map was asked for, which no FMU of two pedals can be given."""
    given = fmus.variables()
    given["u"]["name"] = "throttle"
    given["omega"] |= {"name": "brake", "causality": "input"}
    return given


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (ambiguous(), r"accel may be several .*: y1 \[m/s2\], y2 \[m/s\], drag \[m/s2\]; needs map="),
        (without_a_speed(), r"speed may be several of its outputs, or none: a; needs map="),
        (of_pedals(), r"takes throttle.*brake.*, and no acceleration.*--simulated"),
        (fmus.variables(units={"u": "N"}), r"accel_cmd is variable 'u' in 'N'; .*\[fmu\.unit\]"),
    ],
    ids=["several", "no speed", "pedals", "force"],
)
def test_an_fmu_whose_signals_are_not_found_is_refused(build: Build, given: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        build.open(build.fmu(given=given))


@pytest.mark.parametrize("way", ["argument", "beside", "mapping"])
def test_a_name_that_is_given_decides(build: Build, way: str) -> None:
    path, names = build.fmu(given=ambiguous()), {"accel": "y1", "speed0": "v0", "accel0": "a0"}
    text = "[map]\naccel = 'ACC_X'\n[fmu]\n" + "".join(f"{k} = '{v}'\n" for k, v in names.items())
    arguments: dict[str, Any] = {"map": names}
    if way == "beside":
        arguments = {"map": None}
        path.with_suffix(".toml").write_text(text)
    if way == "mapping":
        arguments = {"map": None, "mapping": build.folder / "lap.toml"}
        arguments["mapping"].write_text(text)
        path.with_suffix(".toml").write_text("[fmu]\naccel = 'y2'\n")  # overruled
    np.testing.assert_allclose(
        driven(build.open(path, **arguments), accel=0.0), expected(accel=0.0, drag=4e-4), **CLOSE
    )


def test_a_log_is_read_beside_the_names_of_an_fmu(tmp_path: Path) -> None:
    (tmp_path / "lap.toml").write_text("[map]\naccel = 'ACC_X'\n[fmu]\naccel = 'y1'\n[fmu.unit]\naccel = 'g'\n")
    assert read_mapping(tmp_path / "lap.csv").column == {"accel": "ACC_X"}


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ({"accel_cmd": "steer"}, r"accel_cmd = 'steer': needs an input, a real variable; candidates: u"),
        ({"accel_cmd": "a"}, r"accel_cmd = 'a': needs an input"),
        ({"speed0": "v"}, r"speed0 = 'v': needs a parameter that can be set"),
        ({"accel": "v", "speed": "v"}, r"variable 'v' is both accel and speed"),
        ({"jerk": "v"}, r"map jerk: not known"),
    ],
)
def test_a_name_that_does_not_fit_is_refused(build: Build, names: dict[str, str], text: str) -> None:
    with pytest.raises(InputError, match=text):
        build.open(build.fmu(), map=names)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fmu = 3", r"car\.toml: fmu is no table"),
        ("[fmu]\nspeed = 3", r"car\.toml: \[fmu\] speed: is a int"),
        ("[fmu]\nunit = 'g'", r"\[fmu\] unit is no table"),
        ("[fmu.unit]\nspeed = 'furlong'", r"speed=furlong: not known"),
        ("[fmu]\nspee = 'v'", r"\[fmu\] spee: not known"),
    ],
)
def test_a_mapping_file_that_is_wrong_is_refused(build: Build, text: str, message: str) -> None:
    path = build.fmu()
    path.with_suffix(".toml").write_text(text)
    with pytest.raises(InputError, match=message):
        build.open(path)


# start -------------------------------------------------------------------------------------------------------------
def test_a_start_that_cannot_be_set_is_the_fmus_own_and_told(build: Build) -> None:
    car = build.open(build.fmu(), map={"accel0": "a0"})
    np.testing.assert_allclose(driven(car), expected(speed=fmus.START["v0"]), **CLOSE)
    assert "speed0: cannot be set; a drive begins at the FMU's own" in car.notes
    assert "speed: the FMU begins at 3 m/s, the drive at 20 m/s" in car.notes
    driven(car, speed=3.0)
    assert not any("the FMU begins" in note for note in car.notes)


def test_outputs_with_start_values_are_started_by_them(build: Build, fmi: int) -> None:
    given = fmus.variables(units={"v": "km/h"})
    for name in ("a", "v"):
        given[name] |= {"initial": "exact", "start": 0.0}
    car = build.open(build.fmu(fmi, given), map={}).with_parameters({"speed_scale": 3.6})
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)
    assert "speed0: variable 'v' (its start value), in km/h" in car.notes


# steps -------------------------------------------------------------------------------------------------------------
def test_a_fixed_step_is_taken_a_whole_number_of_times(build: Build, fmi: int) -> None:
    car = build.open(build.fmu(fmi, step=0.005, variable_step=False)).with_parameters({"only_step": 0.005})
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)
    assert "steps of 0.005 s, no others" in car.notes


def test_another_step_is_refused_with_those_that_are_right(build: Build) -> None:
    car = build.open(build.fmu(step=0.005, variable_step=False))
    for dt in (0.008, 0.002):
        with pytest.raises(InputError, match=rf"dt: found {dt:g} s; .* takes steps of 0.005 s, .* 0.005 or 0.01 s"):
            driven(car, dt)


def test_a_step_that_is_only_preferred_is_divided(build: Build) -> None:
    """0.02 s at 0.008 s at most: three parts of the model's own 7 steps each."""
    accel, _ = driven(build.open(build.fmu(step=0.008)))
    fine = fmus.drive(np.repeat(COMMAND, 3), DT / 3, speed=20.0, accel=0.4)[0]
    np.testing.assert_allclose(accel, fine[2::3], **CLOSE)


def test_steps_must_be_alike_where_the_fmu_says_no_more(build: Build) -> None:
    car = build.open(build.fmu(variable_step=False))
    with pytest.raises(InputError, match=r"dt: found steps from 0\.02 to 0\.03 s; .* all alike"):
        car.whole_drive(COMMAND[:3], [0.02, 0.03, 0.02], speed=20.0, accel=0.0)
    car.reset(speed=20.0, accel=0.0)
    car.step(0.0, 0.02)
    with pytest.raises(InputError, match="all alike"):
        car.step(0.0, 0.03)


@pytest.mark.parametrize(("fmi", "step"), [(2, 0.0), (3, -1.0), (2, np.nan), (3, np.inf)])
def test_a_step_that_is_stated_and_is_none_counts_as_unstated(build: Build, fmi: int, step: float) -> None:
    np.testing.assert_allclose(driven(build.open(build.fmu(fmi, step=step))), expected(), **CLOSE)


# parameters --------------------------------------------------------------------------------------------------------
def test_parameters_are_listed_and_set(build: Build, fmi: int) -> None:
    car = build.open(build.fmu(fmi))
    starts = {k: x for k, x in fmus.START.items() if k not in ("u", "a", "v", "v0", "a0")}
    assert car.parameters() == starts
    slow = car.with_parameters({"omega": 2.0, "drag": 0.0})
    assert slow.parameters() == {**starts, "omega": 2.0, "drag": 0.0}
    np.testing.assert_allclose(driven(slow), expected(omega=2.0, drag=0.0), **CLOSE)
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)
    with pytest.raises(InputError, match="needs reset first"):  # the process has begun the other one's drive
        slow.step(0.0, DT)


def test_side_by_side_each_in_a_process_of_its_own(build: Build) -> None:
    car = build.open(build.fmu())
    places = [{"omega": 2.0}, {"omega": 3.0}, {"omega": 4.0}]
    found = side_by_side(car, lambda own, values: driven(own.with_parameters(values)), places, 2)
    for shown, values in zip(found, places, strict=True):
        np.testing.assert_allclose(shown, expected(**values), **CLOSE)
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)  # its own process goes on


def test_parameters_that_do_not_fit_are_refused(build: Build) -> None:
    given = fmus.variables()
    given["omega"] |= {"min": 0.1, "max": 30.0}
    car = build.open(build.fmu(given=given))
    for name, value, text in (
        ("mass", 1.0, r"parameters: found 'mass', needs one of omega, damping"),
        ("v0", 1.0, r"parameters: found 'v0'"),
        ("omega", np.nan, r"omega: found nan, needs a finite number"),
        ("omega", 31.0, r"omega: found 31.0, needs a finite number from 0.1 to 30"),
        ("fault", 0.5, r"fault: found 0.5, needs a whole number"),
    ):
        with pytest.raises(InputError, match=text):
            car.with_parameters({name: value})


# failures ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("fmi", "fault", "what"),
    [
        (2, fmus.ERROR, r"fmi\dDoStep failed with status 3 \(error\): fuse 17 has blown"),
        (3, fmus.ERROR, r"fmi\dDoStep failed with status 3 \(error\): fuse 17 has blown"),
        (2, fmus.NAN, r"it answers nan"),
        (3, fmus.HANG, r"it does not answer within 0\.4 s"),
        (2, fmus.CRASH, r"it ended the process that ran it \(SIGABRT\)"),
        (3, fmus.EXIT, r"it ended the process that ran it \(status 7\)"),
    ],
    ids=["error", "error of FMI 3", "nan", "hang", "crash", "exit"],
)
def test_a_failure_names_its_time_and_the_next_drive_is_a_new_one(
    build: Build, fmi: int, fault: int, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(build.folder))
    car = build.open(build.fmu(fmi), timeout_s=0.4)
    bad = car.with_parameters({"fault": fault})
    with pytest.raises(InputError, match=rf"car\.fmu: in the step that begins at 1 s of the drive: {what}"):
        driven(bad)
    assert not list(build.folder.glob("avtorch_fmu_*"))  # nothing is left of it
    with pytest.raises(InputError, match="no drive is under way"):
        bad.step(0.0, DT)
    np.testing.assert_allclose(driven(car), expected(), **CLOSE)


def test_a_start_that_hangs_is_ended(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    car = build.open(build.fmu()).with_parameters({"fault": fmus.HANG_AT_START})
    monkeypatch.setattr(fmu, "OPENING_S", 0.4)
    with pytest.raises(InputError, match=r"car\.fmu: before the first step: it does not answer within 0\.4 s$"):
        car.reset(speed=20.0, accel=0.0)


def test_a_failure_step_by_step(build: Build) -> None:
    car = build.open(build.fmu()).with_parameters({"fault": fmus.CRASH})
    car.reset(speed=20.0, accel=0.0)
    for _ in range(50):
        car.step(0.0, DT)
    with pytest.raises(InputError, match="begins at 1 s"):
        car.step(0.0, DT)


def test_numbers_that_are_none_are_refused(build: Build) -> None:
    car = build.open(build.fmu())
    with pytest.raises(InputError, match="accel_cmd: found nan"):
        car.whole_drive([0.0, np.nan], DT, speed=20.0, accel=0.0)
    with pytest.raises(InputError, match="speed: found inf"):
        car.reset(speed=np.inf, accel=0.0)
    with pytest.raises(InputError, match=r"shapes \(3,\) and \(2,\)"):
        car.whole_drive([0.0, 0.0, 0.0], [DT, DT], speed=20.0, accel=0.0)
    for dt in (0.0, -0.1, np.nan, np.inf):
        with pytest.raises(InputError, match="dt: found"):
            driven(car, dt)


def test_what_is_closed_is_refused(build: Build) -> None:
    with build.open(build.fmu()) as car:
        car.reset(speed=20.0, accel=0.0)
    for call in (lambda: car.reset(speed=20.0, accel=0.0), lambda: car.step(0.0, DT)):
        with pytest.raises(InputError, match=r"is closed|no drive"):
            call()


# what is no FMU ----------------------------------------------------------------------------------------------------
def test_what_cannot_be_run_is_refused(build: Build, fmi: int) -> None:
    car = build.folder / "car.fmu"
    with pytest.raises(InputError, match="no such file"):
        build.open(car)
    car.write_text("no ZIP file")
    with pytest.raises(InputError, match="is damaged or of an unknown kind"):
        build.open(car)
    with zipfile.ZipFile(car, "w") as archive:
        archive.writestr("readme.txt", "")
    with pytest.raises(InputError, match=r"is damaged or of an unknown kind .*modelDescription\.xml"):
        build.open(car)
    with pytest.raises(InputError, match="with model exchange alone"):
        build.open(build.fmu(fmi, kind="ModelExchange"))
    xml = fmus.description(fmi, fmus.variables())
    fmus.packed(car, xml, build.compiled[fmi], "riscv-windows")
    with pytest.raises(InputError, match="has no library for this machine, needs one for"):
        build.open(car)
    (build.folder / "broken").write_bytes(b"\x7fELF" + bytes(200))
    fmus.packed(car, xml, build.folder / "broken", fmus.BINARIES[fmi])
    with pytest.raises(InputError, match="is damaged or of an unknown kind"):
        build.open(car)


def test_what_is_not_installed_is_told(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None if name == "fmpy" else there(name, *rest))
    with pytest.raises(InputError, match=re.escape("pip install 'avtorch[fmu]'")):
        build.open(build.fmu())
