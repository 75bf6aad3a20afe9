"""The repaired plant in other tools' terms."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from avtorch.gap import AerodynamicDrag, DeadTime, Saturation, SecondOrderActuator, SensorBias, plant
from avtorch.pedals import PedalMap, PedalTable
from avtorch.remedy import to_autoware, to_carla, to_openpilot, to_sumo, write_exports


def test_what_maps_and_what_is_lost() -> None:
    car = plant([DeadTime(0.2), Saturation(1.5, -2.5), AerodynamicDrag()], T_L=0.4, K_L=0.9)
    told = to_autoware(car)
    assert told.values["acc_time_delay"] == 0.2
    assert told.values["acc_time_constant"] == 0.4
    assert told.values["vel_rate_lim"] == 2.5
    assert [text.partition(":")[0] for text in told.lost] == ["saturation", "aerodynamic_drag"]
    assert "aerodynamic_drag" in told.to_text()
    short = to_openpilot(car)
    assert abs(short.values["longitudinalActuatorDelay"] - 0.6) < 1e-12
    assert any("K_L" in text for text in short.lost)
    assert any("saturation" in text for text in short.lost)


def test_limits_on_one_side_alone() -> None:
    """A limit that was not found is none: it is neither written nor infinite."""
    driving, braking = (plant([x]) for x in (Saturation(1.5, -np.inf), Saturation(np.inf, -2.5)))
    assert to_autoware(driving).values["vel_rate_lim"] == 1.5
    assert to_autoware(braking).values["vel_rate_lim"] == 2.5
    assert dict(to_sumo(driving).values) == {"tauEngine": 0.3, "accel": 1.5}
    assert dict(to_sumo(braking).values) == {"tauEngine": 0.3, "decel": 2.5, "emergencyDecel": 2.5}
    assert any(text.startswith("decel: no limit was found") for text in to_sumo(driving).lost)


def test_what_sumo_has_and_has_not() -> None:
    """Every property of the plant is either an attribute of the vType or a sentence."""
    effects = [DeadTime(0.2), Saturation(1.5, -2.5), SecondOrderActuator(6.0, 0.8), AerodynamicDrag(), SensorBias(0.1)]
    told = to_sumo(plant(effects, K_L=0.9))
    assert told.values["accel"] == 1.5
    assert told.values["decel"] == told.values["emergencyDecel"] == 2.5
    names = {text.partition(":")[0].partition(" ")[0] for text in told.lost}
    assert names == {"tauEngine", "K_L", "dead_time", "second_order_actuator", "aerodynamic_drag", "sensor_bias"}
    root = ElementTree.fromstring(told.to_text())
    (written,) = root.findall("vType")
    assert written.attrib == {
        "id": "car",
        "carFollowModel": "CC",
        "lanesCount": "1",
        "tauEngine": f"{told.values['tauEngine']:.6g}",
        "accel": "1.5",
        "decel": "2.5",
        "emergencyDecel": "2.5",
    }


@pytest.fixture
def pedals() -> PedalMap:
    """A throttle, and a brake in Pa."""
    throttle = PedalTable(np.array([0.0, 0.5, 1.0]), np.array([[0, 0], [1.0, 0.5], [4.0, 2.0]]))
    brake = PedalTable(np.array([0.0, 4e6]), np.array([[0, 0], [-6.0, -7.0]]))
    return PedalMap(np.array([0.0, 30.0]), np.array([-0.1, -0.6]), {"throttle": throttle, "brake": brake}, 0.25, 0.1)


def test_what_carla_has_and_has_not(pedals: PedalMap) -> None:
    """Accelerations of the tables are those of the map, in CARLA's own pedals; the rest is told."""
    told = to_carla(pedals)
    for name, full in (("throttle", 1.0), ("brake", 4e6)):
        table = told.tables[name]
        for row, share in enumerate(table.pedal):
            given = {other: np.zeros(2) for other in pedals.pedals} | {name: np.full(2, share * full)}
            assert table.accel[row] == pytest.approx(pedals.accel(table.speed, **given))
    assert told.lost[0].startswith("lag 0.25 s and dead time 0.1 s")
    assert any("a pedal of 1 is 4e+06 Pa" in text for text in told.lost)
    found = plant([DeadTime(0.2), AerodynamicDrag()], T_L=0.4, K_L=0.9)
    behind = to_carla(pedals, found).lost
    assert behind[0].startswith("lag 0.4 s and dead time 0.2 s")
    assert [text.partition(":")[0] for text in behind[-2:]] == ["K_L 0.9", "aerodynamic_drag"]


def test_what_is_written(pedals: PedalMap, tmp_path: Path) -> None:
    """CARLA's where there are pedals, the others where there is a plant; earlier ones go."""
    late = plant([DeadTime(0.2)])
    both = [path.name for path in write_exports(late, tmp_path, pedals=pedals)]
    assert both == ["plant.autoware.yaml", "plant.openpilot.yaml", "plant.sumo.xml", "plant.carla.yaml"]
    text = (tmp_path / "plant.carla.yaml").read_text()
    assert "throttle:\n  speed: [0, 30]\n  0: [-0.1, -0.6]\n  0.5: [0.9, -0.1]\n" in text
    assert [path.name for path in write_exports(None, tmp_path, pedals=pedals)] == ["plant.carla.yaml"]
    assert [path.name for path in tmp_path.glob("plant.*")] == ["plant.carla.yaml"]
