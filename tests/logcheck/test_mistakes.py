"""Twenty mistakes of logs as they come, each corrected and told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.io import Log
from avtorch.io.units import GRAVITY

from .drives import Columns, drive, written

MPH = 3600 / 1609.344


def named(d: Columns, **names: str) -> Columns:
    return {names.get(name, name): values for name, values in d.items()}


def scaled(d: Columns, **factors: float) -> Columns:
    return {name: values * factors.get(name, 1.0) for name, values in d.items()}


MISTAKES: dict[str, Callable[[Columns], Columns]] = {
    "km/h in the header": lambda d: named(scaled(d, speed=3.6), speed="VehSpd_kph"),
    "km/h unsaid": lambda d: scaled(d, speed=3.6),
    "mph unsaid": lambda d: scaled(d, speed=MPH),
    "mph named km/h": lambda d: named(scaled(d, speed=MPH), speed="speed [km/h]"),
    "km/h with g": lambda d: scaled(d, speed=3.6, accel=1 / GRAVITY, accel_cmd=1 / GRAVITY),
    "km/h with g in a header": lambda d: named(
        scaled(d, speed=3.6, accel=1 / GRAVITY, accel_cmd=1 / GRAVITY), speed="v (km/h)", accel="ax (g)"
    ),
    "g of the sensor alone": lambda d: scaled(d, accel=1 / GRAVITY),
    "cm/s2": lambda d: named(scaled(d, accel=100.0), accel="accel [cm/s²]"),
    "sensor backwards": lambda d: scaled(d, accel=-1.0),
    "sensor backwards in g": lambda d: named(scaled(d, accel=-1.0 / GRAVITY), accel="AccX [g]"),
    "command reversed": lambda d: scaled(d, accel_cmd=-1.0),
    "command and response swapped": lambda d: named(d, accel="accel_cmd", accel_cmd="accel"),
    "milliseconds": lambda d: named(scaled(d, time=1e3), time="t_ms"),
    "microseconds unsaid": lambda d: scaled(d, time=1e6),
    "nanoseconds since 1970": lambda d: d | {"time": d["time"] * 1e9 + 1.7e18},
    "camel case": lambda d: named(d, accel_cmd="AccelRequest", accel="LongAccel", speed="VehicleSpeed"),
    "German": lambda d: named(
        scaled(d, speed=3.6),
        time="Zeit [s]", accel_cmd="Sollbeschleunigung [m/s²]", accel="Beschleunigung [m/s²]",
        speed="Geschwindigkeit [km/h]",
    ),
    "dotted": lambda d: named(
        d, accel_cmd="carControl.actuators.accel_target", accel="carState.aEgo", speed="carState.vEgo"
    ),
    "letters": lambda d: named(d, time="t", accel_cmd="u", accel="a", speed="v"),
    "command without a name": lambda d: named(d, accel_cmd="signal 17"),
    "without an accelerometer in km/h": lambda d: {k: v for k, v in scaled(d, speed=3.6).items() if k != "accel"},
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_corrected_and_told(mistake: str, tmp_path: Path, fresh_seed: int) -> None:
    right = drive(fresh_seed)
    wrong = MISTAKES[mistake](right)
    wrong["note"] = np.random.default_rng(fresh_seed).standard_normal(len(right["time"]))
    path = written(tmp_path / "drive.csv", wrong)
    found = avtorch.check(path)
    assert found.fault is None
    assert found.proposal is not None
    assert found.proposal.needed
    assert all(one.reason for one in found.proposal.signals.values())
    (tmp_path / "drive.toml").write_text(found.proposal.toml("drive.csv"), encoding="utf-8")
    log = Log.read(path)
    assert np.allclose(log.elapsed, right["time"], atol=1e-6, rtol=0)
    for name in ("accel_cmd", "accel", "speed"):
        values = getattr(log, name)
        if name == "accel" and values is None:
            assert "accel" not in wrong
            continue
        assert np.allclose(values, right[name], rtol=1e-9, atol=1e-9), name


def test_a_good_log_needs_nothing(tmp_path: Path, fresh_seed: int) -> None:
    log = Log.from_arrays(**drive(fresh_seed))
    log.write(tmp_path / "drive.csv")
    found = avtorch.check(tmp_path / "drive.csv")
    assert found.proposal is not None
    assert not found.proposal.needed
    assert found.proposal.doubts == ()


def test_units_that_the_data_cannot_tell_apart_are_told(tmp_path: Path, fresh_seed: int) -> None:
    """cm/s² and thousandths of g differ by 2 %."""
    log = Log.from_arrays(**drive(fresh_seed))
    columns = {"time": log.time, "accel_cmd": log.accel_cmd, "accel": 100.0 * log.accel, "speed": log.speed}
    found = avtorch.check(written(tmp_path / "drive.csv", columns))
    assert found.proposal is not None
    assert found.proposal.unit["accel"] in ("mg", "cm/s2")
    assert any("the data allow accel in" in doubt for doubt in found.proposal.doubts)
    (tmp_path / "drive.toml").write_text(found.proposal.toml("drive.csv"), encoding="utf-8")
    again = avtorch.check(tmp_path / "drive.csv")
    assert again.proposal is None, "a mapping is beside it now"
    assert again.quality is not None


def test_a_signal_that_arrives_now_and_then_is_held(tmp_path: Path, fresh_seed: int) -> None:
    d = drive(fresh_seed)
    speed = [v if i % 5 == 0 else "" for i, v in enumerate(d["speed"].tolist())]
    found = avtorch.check(written(tmp_path / "drive.csv", {**d, "speed": speed}))
    assert found.proposal is not None
    assert found.proposal.stamp == {"speed": "time"}
    assert "written in 20% of the rows" in found.proposal.signals["speed"].reason
    assert found.log is not None
    assert np.array_equal(found.log.speed[:10], np.repeat(d["speed"][[0, 5]], 5))
