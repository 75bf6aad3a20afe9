"""What to set, from a diagnosis as it is."""

import json
from pathlib import Path

import pytest

import avtorch
from avtorch.remedy import setting_for, write_exports
from benchmarks.blindtest import draw_case


@pytest.mark.slow
def test_of_a_named_cause_and_of_none(tmp_path: Path) -> None:
    case = draw_case(
        0,
        20,
        mix={"none": 0.0, "single": 1.0, "pair": 0.0, "outside": 0.0},
        effects=["dead_time"],
        tiers=["easy"],
        seconds=60.0,
        manoeuvre="steps",
    )
    log = case.log()
    late = avtorch.diagnose(log, effects=["dead_time", "sensor_bias"], pairs=False)
    assert late.verdict.name == "dead_time"
    told = setting_for(late, log.accel_cmd)
    assert told is not None
    json.dumps(told.to_dict(), allow_nan=False)
    assert set(late.belief or ()) == {"T_L", "K_L", "dead_time.delay_s"}
    names = [p.name for p in write_exports(late.plant, tmp_path)]
    assert names == ["plant.autoware.yaml", "plant.openpilot.yaml", "plant.sumo.xml"]
    plain = draw_case(0, 20, mix={"none": 1.0}, seconds=60.0, manoeuvre="steps").log()
    nothing = avtorch.diagnose(plain, effects=["sensor_bias"], pairs=False)
    assert nothing.verdict.name == "none"
    assert setting_for(nothing) is not None
    assert write_exports(None, tmp_path) == []
    assert list(tmp_path.iterdir()) == []
