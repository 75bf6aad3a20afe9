"""The whole diagnosis on drives of the reference vehicle: clear effects are named, absent ones are not."""

import json
from pathlib import Path

import pytest

import avtorch
from avtorch.blindtest import draw_case
from avtorch.errors import InputError
from avtorch.gap.search.checkpoint import SCHEMA
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log, read_sealed, write_sealed


def _drive(effect: str, index: int = 0) -> Log:
    case = draw_case(
        index,
        20,
        mix={"none": 0.0, "single": 1.0, "pair": 0.0, "outside": 0.0},
        effects=[effect],
        tiers=["medium"],
        seconds=60.0,
        manoeuvre="steps",
    )
    return case.log()


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["sensor_bias", "outliers"])
def test_a_plain_cause_leads_by_evidence(effect: str) -> None:
    answer = avtorch.diagnose(_drive(effect), effects=[effect, "aerodynamic_drag", "sensor_scale"], pairs=False)
    named = [c for c in answer.candidates if c.log_evidence is not None and "+" not in c.name]
    assert max(named, key=lambda c: c.log_evidence or 0.0).name == effect
    assert sum(c.probability for c in answer.candidates) == pytest.approx(1.0)
    json.dumps(answer.to_dict(), allow_nan=False)


@pytest.mark.slow
def test_a_search_cut_off_goes_on_to_the_same_answer(tmp_path: Path) -> None:
    log, kept = _drive("sensor_bias"), tmp_path / "fits.json"
    only = {"effects": ["sensor_bias", "aerodynamic_drag"], "pairs": False}
    whole = avtorch.diagnose(log, checkpoint=kept, **only)
    done, content = read_sealed(kept, schema=SCHEMA), kept.read_bytes()
    assert len(done.content["fits"]) >= 2
    write_sealed(kept, {"fits": done.content["fits"][:1]}, schema=SCHEMA, of=done.of)
    again = avtorch.diagnose(log, checkpoint=kept, **only)
    assert again.to_dict() == whole.to_dict()
    assert kept.read_bytes() == content


def test_wrong_arguments_are_refused(tmp_path: Path) -> None:
    log = _drive("sensor_bias")
    with pytest.raises(InputError, match="posterior"):
        avtorch.diagnose(log, posterior="guess")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="accel_kind"):
        avtorch.diagnose(log, accel_kind="gravity")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no_such"):
        avtorch.diagnose(log, effects=["no_such"])
    bad = tmp_path / "fits.json"
    bad.write_text("[]")
    with pytest.raises(InputError, match=r"fits\.json"):
        avtorch.diagnose(log, checkpoint=bad)


@pytest.mark.slow
def test_the_repaired_simulator_reads_back() -> None:
    answer = avtorch.diagnose(_drive("sensor_bias"), effects=["sensor_bias"], pairs=False)
    if answer.plant is None:
        pytest.fail(f"verdict {answer.verdict.name}, expected a plain bias to be named")
    again = GapPlant.from_toml(answer.plant.to_toml())
    assert [e.name for e in again.effects] == [e.name for e in answer.plant.effects]
