"""The effect of docs/own-effect.md among the candidates of a diagnosis: one class in one file is all it takes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import avtorch
from avtorch.gap import EFFECTS, plant
from tests.gap.records import log_of

PAGE = Path(__file__).resolve().parents[3] / "docs" / "own-effect.md"


@pytest.mark.slow
def test_one_of_each_kind_is_named_by_the_pages_own_code(capsys: pytest.CaptureFixture[str]) -> None:
    before = dict(EFFECTS)
    names: dict = {}
    try:
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S):
            exec(compile(block, "own-effect.md", "exec", dont_inherit=True), names)
    finally:
        EFFECTS.clear()
        EFFECTS.update(before)
    said = capsys.readouterr().out
    # nats over none; the noise is that of one seed
    for key, effect, least in (("weak", "motor_power", 60), ("hot", "hot_motor", 14), ("found", "crosstalk", 550)):
        found = names[key]
        assert f"{effect} has probability" in said
        assert found.verdict.names == (effect,)
        assert least < (found.winner.log_evidence or 0.0) < 4 * least
        assert found.plant is not None
        assert f"[{effect}]" in found.plant.to_toml()
    fade = names["hot"].winner.parameters["fade"]
    assert abs(fade.mean - 0.15) < 5 * fade.sd
    noise = names["found"].plant.effects[0].noise_sd
    assert noise != 0.02  # the log's, not the class's
    assert noise == pytest.approx(0.02, rel=0.1)


@pytest.fixture
def trailer():
    """The page's first class; the registry is as before after the test."""
    before = dict(EFFECTS)
    names: dict = {}
    block = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)[0]
    exec(compile(block, "own-effect.md", "exec", dont_inherit=True), names)
    yield names["Trailer"]
    EFFECTS.clear()
    EFFECTS.update(before)


@pytest.mark.slow
@pytest.mark.statistical
def test_it_leads_and_is_measured(trailer: type, rotating_seed: int) -> None:
    log = log_of(plant([trailer(0.4)], T_L=0.4), seconds=40.0, rng=np.random.default_rng(rotating_seed))
    found = avtorch.diagnose(log, effects=["trailer", "dead_time", "sensor_scale", "sensor_bias"], pairs=False)
    evidence = {c.name: c.log_evidence for c in found.candidates if c.log_evidence is not None}
    # some 60 nats more; none of the others can pull less and brake as before
    assert evidence.pop("trailer") > max(evidence.values()) + 15
    told = next(c for c in found.candidates if c.name == "trailer")
    assert told.probability == max(c.probability for c in found.candidates if c.name != "unknown")
    ratio = told.parameters["mass_ratio"]
    assert abs(ratio.mean - 0.4) < 6 * ratio.sd


def test_without_registration_it_is_handed_over(trailer: type) -> None:
    EFFECTS.pop("trailer")
    log = log_of(plant([trailer(0.4)], T_L=0.4), seconds=20.0, rng=np.random.default_rng(6))
    found = avtorch.diagnose(log, effects=[trailer, "dead_time"], pairs=False)
    assert {c.name for c in found.candidates} <= {"trailer", "dead_time", "none", "unknown"}
    assert found.probability("trailer") > found.probability("dead_time")
