"""Commands that are no accelerations are signals like others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.errors import InputError
from avtorch.io import Log
from tests.io.drives import drive, write

SIGNALS = ("throttle", "brake", "torque", "current", "speed_cmd")


def columns(**more: np.ndarray) -> dict:
    given = drive()
    del given["accel_cmd"]
    return given | more


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("signal", SIGNALS)
def test_one_of_them_stands_for_accel_cmd(signal: str, tmp_path: Path) -> None:
    values = np.linspace(0.0, 0.9, 1500)
    log = Log.read(write(tmp_path / "lap.csv", columns(**{signal: values})))
    assert log.accel_cmd is None
    assert np.array_equal(getattr(log, signal), values)
    assert log.pedals == ((signal,) if signal != "speed_cmd" else ())
    for name in ("back.csv", "back.parquet"):
        log.write(tmp_path / name)
        assert np.array_equal(getattr(Log.read(tmp_path / name), signal), values)
    assert len(getattr(log[10:20], signal)) == 10


def test_without_any_the_message_names_them(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="throttle, brake, torque, current or speed_cmd can stand for it"):
        Log.read(write(tmp_path / "lap.csv", columns()))


@pytest.mark.parametrize(
    ("signal", "unit", "factor"),
    [
        ("throttle", "%", 0.01),
        ("brake", "%", 0.01),
        ("brake", "bar", 1e5),
        ("brake", "kPa", 1e3),
        ("torque", "kNm", 1e3),
        ("current", "mA", 1e-3),
        ("speed_cmd", "km/h", 1 / 3.6),
    ],
)
def test_units(signal: str, unit: str, factor: float) -> None:
    values = np.linspace(0.0, 50.0, 1500)
    log = Log.from_arrays(**columns(**{signal: values}), unit={signal: unit})
    assert getattr(log, signal) == pytest.approx(factor * values)


def test_a_throttle_in_percent_is_refused_with_its_unit() -> None:
    with pytest.raises(InputError, match="`--unit throttle=%` if that is its unit"):
        Log.from_arrays(**columns(throttle=np.linspace(0.0, 80.0, 1500)))


@pytest.mark.parametrize(
    ("name", "signal", "unit"),
    [
        ("Throttle_pct", "throttle", "%"),
        ("AcceleratorPedalPos [%]", "throttle", "%"),
        ("BrakePressure [bar]", "brake", "bar"),
        ("brake_kPa", "brake", "kPa"),
        ("EngineTorqueRequest_Nm", "torque", None),
        ("motor_current [A]", "current", None),
        ("speed_setpoint_kph", "speed_cmd", "km/h"),
    ],
)
def test_names_are_recognised(name: str, signal: str, unit: str | None, tmp_path: Path) -> None:
    path = write(tmp_path / "lap.csv", columns(**{name: 40 + 30 * np.sin(np.linspace(0.0, 20.0, 1500))}))
    found = avtorch.check(path)
    assert found.proposal is not None
    assert found.proposal.map[signal] == name
    assert found.proposal.unit.get(signal) == unit
    assert found.fault is None
    assert not found.proposal.doubts


def test_estimates_of_pedals_alone_say_what_to_do() -> None:
    log = Log.from_arrays(**columns(throttle=np.linspace(0.0, 0.9, 1500)))
    with pytest.raises(InputError, match=r"avtorch\.pedals\.fit_pedals makes one of its throttle"):
        avtorch.estimate(log, window=5.0)


def test_beside_a_command_they_refuse_nothing_and_cost_no_row(tmp_path: Path) -> None:
    """Many logs hold a throttle in per cent, or a current with a torn cell; with a command neither is needed."""
    given = drive()
    current = [repr(float(x)) for x in np.linspace(0.0, 9.0, 1500)]
    current[4] = "n/a"
    path = write(tmp_path / "lap.csv", given | {"throttle": np.linspace(0.0, 90.0, 1500), "current": current})
    log = Log.read(path)
    assert log.rows == 1500
    assert log.pedals == ()
    told = " ".join(log.remarks)
    assert "`--unit throttle=%` if that is its unit); throttle is left out" in told
    assert "row 5 (line 6), column 'current': 'n/a' is no number; a number is needed; current is left out" in told
    assert Log.read(path, unit=["throttle=%"]).pedals == ("throttle",)
