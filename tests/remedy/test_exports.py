"""The repaired plant in other tools' terms."""

from avtorch.gap import AerodynamicDrag, DeadTime, Saturation, plant
from avtorch.remedy import to_autoware, to_openpilot


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
