"""A search that did not try everything, cut by its budget or without pairs: the answer reports this and claims no
more."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import avtorch
from avtorch.cli.diagnosis_table import diagnosis_headline, diagnosis_notes
from avtorch.gap import DeadTime, Outliers, SensorBias, plant
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.result import sentences
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.search.own_noise_fit import OwnNoiseFits
from avtorch.gap.search.screening import Screened
from avtorch.gap.search.time_budget import TimeBudget
from avtorch.gap.simulator.effect import EFFECTS
from avtorch.io import Log
from avtorch.report import report_html
from tests.gap.records import log_of

AMONG = ["sensor_bias", "sensor_scale", "outliers", "gust", "command_hold", "dead_time"]


def _log(*, seconds: float = 30.0, seed: int = 3, outliers: bool = False) -> Log:
    """A car with a dead time of 0.3 s."""
    rng = np.random.default_rng(seed)
    log = log_of(plant([DeadTime(0.3)]), seconds=seconds, rng=rng)
    if not outliers:
        return log
    assert log.accel is not None
    hit = rng.random(log.rows) < 0.05
    accel = log.accel + np.where(hit, rng.choice([-1.0, 1.0], log.rows), 0.0)
    return Log.from_arrays(name=log.name, time=log.time, accel_cmd=log.accel_cmd, accel=accel, speed=log.speed)


def _cut(monkeypatch: pytest.MonkeyPatch, log: Log, after: int) -> Diagnosis:
    """Diagnosed with a budget that is spent at the search's question number `after`, whatever the machine's speed."""
    asked = 0

    def spent(self: TimeBudget) -> bool:
        nonlocal asked
        asked += 1
        self.complete = self.complete and asked <= after
        return asked > after

    monkeypatch.setattr(TimeBudget, "spent", spent)
    return avtorch.diagnose(log, effects=AMONG)


@pytest.mark.parametrize("after", [0, 2])
def test_a_budget_distinguishes_nothing_from_untried_effects(monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    found = _cut(monkeypatch, _log(), after)
    assert not found.complete
    assert found.scope is not None
    assert "dead_time" in found.scope.not_scored
    assert not {c.name for c in found.candidates} & set(found.scope.not_scored)
    answer = json.loads(json.dumps(found.to_dict()))
    assert answer["not_tried"] == {"effects": list(found.scope.not_scored), "pairs": "none"}
    # `unknown` stands for the untried, and every text lists what was not tried
    assert "unknown" in found.verdict.alias_set
    for text in (str(found), "\n".join([*diagnosis_headline(found), *diagnosis_notes(found)])):
        assert "old apart from every" not in text
        assert "none of the effects known here" not in text
        assert "Not tried: " in text
        assert "dead_time" in text
        assert "Provisional" in text
    assert any("dead_time" in note for note in answer["notes"])


@pytest.mark.slow
def test_what_the_budget_kept_from_a_closer_fit_keeps_its_first_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    found = _cut(monkeypatch, _log(), 4)  # three deterministic effects looked at, then a gust, then no more
    assert not found.complete
    assert found.verdict.name == "dead_time"
    assert found.scope is not None
    assert set(found.scope.not_scored) & set(AMONG) == {"command_hold"}
    assert found.scope.pairs == "none"


@pytest.mark.slow
def test_without_pairs_nothing_holds_a_pair() -> None:
    found = avtorch.diagnose(_log(outliers=True), effects=AMONG, pairs=False)
    assert found.complete
    names = [*found.verdict.alias_set, *(c.name for c in found.candidates), *(c.name for c in found.contenders)]
    assert not [n for n in names if "+" in n]
    answer = found.to_dict()["not_tried"]
    assert not set(answer["effects"]) & set(AMONG)
    assert answer["pairs"] == "none"
    # the truth is a pair: the sentences leave room for it
    assert "and pairs. Probabilities cover only what was tried" in str(found)
    assert "every other hypothesis." not in sentences.aliases(found)


def test_where_the_likelihood_is_lost_held_out_blocks_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    """No adequate noise after the best single effect: neither others nor pairs get noise of their own."""
    monkeypatch.setattr("avtorch.gap.diagnose._unknown", lambda found, record, prior: 1.0)
    settled: list[str] = []
    best_form = OwnNoiseFits.best_form

    def counted(self: OwnNoiseFits, forms: Sequence[Screened], noise: NoiseModel) -> FittedModel:
        settled.append(forms[0].hypothesis.name)
        return best_form(self, forms, noise)

    monkeypatch.setattr(OwnNoiseFits, "best_form", counted)
    found = avtorch.diagnose(_log(), effects=["sensor_bias", "dead_time", "sensor_lag"])
    assert settled == ["dead_time"]
    assert found.complete
    answer = found.to_dict()
    assert answer["not_tried"]["pairs"] == "lost"
    assert any("tried no pairs" in note for note in answer["notes"])


@pytest.mark.slow
def test_effects_that_were_not_asked_for_are_not_ruled_out() -> None:
    """Once "distinguished from every other hypothesis" and "none of the effects known here", of two effects tried."""
    chosen = ["sensor_bias", "sensor_scale"]
    found = avtorch.diagnose(_log(), effects=chosen)
    assert found.complete
    answer = found.to_dict()["not_tried"]
    assert sorted([*answer["effects"], *chosen]) == sorted(EFFECTS)
    assert answer["pairs"] == "all"
    page = report_html(found)
    for text in (str(found), "\n".join([*diagnosis_headline(found), *diagnosis_notes(found)]), page):
        assert "known here" not in text
        assert "known effect leaves" not in text
        assert "every other hypothesis." not in text
        assert "Not tried: " in text
        assert "aerodynamic_drag" in text
        assert "Provisional" not in text
    assert f"tried, 2 of {len(EFFECTS)}" in sentences.headline(found)


@pytest.mark.slow
def test_a_complete_search_reports_nothing_untried() -> None:
    found = avtorch.diagnose(_log(), effects=[DeadTime, SensorBias, Outliers])
    assert found.scope is not None
    whole = replace(found, scope=replace(found.scope, not_scored=()), notes=())
    assert whole.scope is not None
    assert sentences.untried(whole.scope) == []
    assert sentences.aliases(whole) == "No other known cause explains this log as well."
    assert "Provisional" not in str(found)


def test_a_choice_of_effects_is_not_taken_for_all_that_are_known() -> None:
    """A dead time of 0.3 s, with only a bias and outliers to choose from."""
    found = avtorch.diagnose(_log(), effects=["sensor_bias", "outliers"])
    assert found.complete
    text = f"{found}\n{found.verdict.why}"
    assert found.verdict.name in ("unknown", "none")
    assert "known here" not in text
    assert "known effect" not in text
    assert "lacks nothing" not in text
    assert "tried" in str(found).splitlines()[0]
