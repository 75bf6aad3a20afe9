"""The whole diagnosis: clear effects of the reference vehicle are named, absent ones are not; how far it is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch import GLVDPlant, Leader, diagnose, simulate
from avtorch.errors import InputError
from avtorch.gap.diagnose import STEPS, WholeProgress
from avtorch.gap.effects.sensor_bias import SensorBias
from avtorch.io import Log
from benchmarks.blindtest import draw_case
from tests.gap.cars import log_of


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


def test_wrong_arguments_are_refused() -> None:
    log = _drive("sensor_bias")
    with pytest.raises(InputError, match="posterior"):
        avtorch.diagnose(log, posterior="guess")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="accel_kind: found 'gravity'"):
        avtorch.diagnose(log, accel_kind="gravity")  # type: ignore[arg-type]


@pytest.mark.slow
def test_an_onset_is_told_on_the_logs_own_clock(tmp_path: Path, fresh_seed: int) -> None:
    """A bias from 75 s on, by a clock from 1000 s on."""
    plain, biased = (log_of(effects, seed=fresh_seed) for effects in ([], [SensorBias(0.5)]))
    accel = np.where(plain.time > 75.0, biased.accel, plain.accel)
    log = Log.from_arrays(
        name="car", time=plain.time + 1000.0, accel_cmd=plain.accel_cmd, accel=accel, speed=plain.speed
    )
    # the slow force in the noise of `log_of` is a gust's
    found = diagnose(log, effects=["dead_time", "sensor_bias", "gust"], posterior="laplace")
    assert found.verdict.names[0] == "sensor_bias"
    assert found.onset_s == pytest.approx(1075.0, abs=1.0)
    assert found.onset_from_start_s == pytest.approx(75.0, abs=1.0)
    assert "The gap begins at 7" in str(found)
    found.write(tmp_path)
    assert (tmp_path / "plant.toml").read_text().startswith("# In the log sensor_bias")
    # and the repaired simulator's course is the bare one's until then
    assert found.traces is not None
    channel = found.traces.channels.index("accel")
    early = found.traces.time < 73.0
    moved = np.abs(found.traces.after - found.traces.before)[channel]
    assert moved[early].max() < 0.2 < moved[found.traces.time > 80.0].mean()


def _told(*steps: tuple[str, int, int]) -> list[int]:
    told: list[int] = []
    whole = WholeProgress(lambda what, done, of: told.append(done))
    for step in steps:
        whole(*step)
    return told


def test_a_stage_that_is_made_again_does_not_turn_it_back() -> None:
    told = _told(("effects", 1, 4), ("recorder", 0, 1), ("effects", 1, 4), ("effects", 3, 4), ("average", 0, 1))
    assert told == sorted(told)
    assert told[0] == told[1] == told[2] < told[3] < told[4] < STEPS


def test_a_stage_that_nobody_expects_leaves_it_where_it_is() -> None:
    assert _told(("effects", 1, 2), ("something else", 3, 4))[1] == _told(("effects", 1, 2))[0]


def test_a_diagnosis_tells_steps_of_the_whole() -> None:
    log = simulate(Leader.default(start=50.0, duration=14.0, dt=0.05), plant=GLVDPlant(0.5, 0.9)).log()
    told: list[tuple[str, int, int]] = []
    diagnose(log, effects=["dead_time", "sensor_bias"], progress=lambda *step: told.append(step))
    assert {of for *_, of in told} == {STEPS}
    done = [done for _, done, _ in told]
    assert done == sorted(done)
    assert done[-1] == STEPS
    assert {"recorder", "outliers", "average", "held-out blocks"} <= {what for what, *_ in told}
