"""libsumo as a real part: what `to_sumo` writes is what SUMO drives, and what SUMO does behind a leader is found.

Run by `make test-all`, which installs libsumo.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("libsumo")

import sumo_data
from lxml import etree

from avtorch import ExternalSimulator, compare_simulators, diagnose
from avtorch.external import check_simulator
from avtorch.gap import Saturation, plant
from avtorch.io import Log
from avtorch.remedy import to_sumo
from tests.external.sumo import SumoCar, followed

pytestmark = pytest.mark.slow

T_L, DRIVE, BRAKE = 0.8, 1.2, 2.0
FEW = ["saturation", "dead_time", "constant_resistance", "rate_limit", "sensor_bias"]


@pytest.fixture
def types(tmp_path: Path) -> Path:
    """A found plant, exported."""
    path = tmp_path / "plant.sumo.xml"
    path.write_text(to_sumo(plant([Saturation(DRIVE, -BRAKE)], T_L=T_L)).to_text())
    return path


def read_with_noise(log: Log) -> Log:
    """As a car's sensors read it."""
    rng = np.random.default_rng(3)
    noisy = {"accel": log.accel + 0.03 * rng.standard_normal(log.rows)}
    return replace(log, speed=log.speed + 0.01 * rng.standard_normal(log.rows), **noisy)


def test_the_export_keeps_to_sumos_own_schema(types: Path) -> None:
    folder = Path(sumo_data.__path__[0]) / "data" / "xsd"
    schema = etree.XMLSchema(etree.parse(folder / "additional_file.xsd"))
    assert schema.validate(etree.parse(types)), schema.error_log


def test_sumo_drives_what_was_exported(types: Path, tmp_path: Path) -> None:
    """Under Plexe's controllers with the lag, and under TraCI without it, as the export says; with both limits."""
    by_engine = check_simulator(SumoCar(tmp_path, types, dt=0.02, plexe=True), step_s=0.02)
    assert by_engine.values["T_L"] == pytest.approx(T_L, abs=0.02)  # SUMO's is an implicit step of 0.02 s
    assert by_engine.values["saturation.accel_max_mps2"] == pytest.approx(DRIVE, rel=0.02)
    at_once = check_simulator(SumoCar(tmp_path, types, dt=0.02), step_s=0.02)
    assert at_once.values["T_L"] <= 0.02  # the least that is tried
    assert at_once.values["saturation.accel_max_mps2"] == pytest.approx(DRIVE, rel=0.02)
    assert at_once.values["saturation.accel_min_mps2"] == pytest.approx(-BRAKE, rel=0.02)
    for found in (by_engine, at_once):
        assert found.output.accel is not None
        assert found.output.accel.min() >= -BRAKE - 1e-9


def time_gap(gap: float, speed: float, lead: float) -> float:
    """A sporty follower, whose wishes go beyond the limits of the type."""
    return 0.6 * (gap - 2.0 - 1.3 * speed) + 1.5 * (lead - speed)


def test_limits_are_found_behind_a_leader(types: Path, tmp_path: Path) -> None:
    """A car in SUMO follows: its limits are what bare GLVD lacks, and what SUMO with its own type does not."""
    log = read_with_noise(followed(tmp_path, types, time_gap, swing=1.8, seconds=120.0))
    found = diagnose(log, effects=FEW, pairs=False)
    assert found.verdict.names == ("saturation",)
    for name, true in (("accel_max_mps2", DRIVE), ("accel_min_mps2", -BRAKE)):
        size = found.winner.parameters[name]
        assert abs(size.mean - true) < 5 * size.sd
    other = tmp_path / "other.xml"
    other.write_text(to_sumo(plant([Saturation(2.6, -4.5)])).to_text())
    told = compare_simulators(
        log,
        ExternalSimulator(SumoCar(tmp_path, other), name="SUMO's default"),
        ExternalSimulator(SumoCar(tmp_path, types), name="the right type"),
    )
    assert told.nearer == "second"
    (chief, *_) = told.differences
    assert chief.name == "saturation"
    assert chief.brings_nearer


def intelligent_driver(gap: float, speed: float, lead: float) -> float:
    """What SUMO's IDM wishes (Treiber et al. 2000), with a gap of 2.5 m at standstill, 1.2 s, 3 m/s² and 40 m/s."""
    gap_wished = max(0.0, 2.5 + 1.2 * speed + speed * (speed - lead) / (2 * 3.0))
    return 3.0 * (1 - (speed / 40.0) ** 4 - (gap_wished / gap) ** 2)


@pytest.mark.parametrize("action_s", [0.1, 0.5, 1.0])
def test_the_time_between_decisions_delays_by_up_to_half_of_it(action_s: float, tmp_path: Path) -> None:
    """A decision is held for n steps of 0.1 s, so it is (n - 1) / 2 of these old on average; for one step it is new.

    SUMO's model decides for the whole time until its next decision, foreseeing its own speed, which takes some of that
    away; half of it has to be left. A wish that is held for a second is as likely no cause of the table (.50): its
    delay is that of the dead time that stands beside.
    """
    types = tmp_path / "idm.xml"
    own = 'carFollowModel="IDM" accel="3" decel="3" tau="1.2" sigma="0" maxSpeed="40" speedDev="0"'
    types.write_text(f'<additional><vType id="car" {own} actionStepLength="{action_s}"/></additional>')
    log = read_with_noise(followed(tmp_path, types, intelligent_driver, own_model=True, seconds=120.0))
    found = diagnose(log, effects=FEW, pairs=False)
    late = float((found.plant or found.simulator).values()["T_L"])
    if "dead_time" in found.verdict.alias_set:
        late += next(c for c in found.candidates if c.name == "dead_time").parameters["delay_s"].mean
    most = (action_s - 0.1) / 2
    assert most / 2 <= late < most + 0.05  # half a step of the log
    # a wish that is held for half a second is no dead time all the same: it leaves a tone of its own
    assert ("dead_time" in found.verdict.alias_set) == (action_s > 0.1)
