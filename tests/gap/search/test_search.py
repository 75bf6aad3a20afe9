"""The search on short drives: what is tried, what is fitted anew, and what is kept."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.blindtest import Car, simulate
from avtorch.blindtest.drives import Recorded
from avtorch.gap import (
    EFFECTS,
    AerodynamicDrag,
    CommandHold,
    ConstantResistance,
    DeadTime,
    Effect,
    Saturation,
    SensorBias,
    SensorScale,
    plant,
)
from avtorch.gap.drive_record import Record
from avtorch.gap.search.fitted_model import FittedModel, SearchResult
from avtorch.gap.search.search import Search
from avtorch.io import Log
from tests.gap.records import command_over

SENSOR = (SensorBias, SensorScale)


def _log(
    effects: dict[str, dict[str, float]],
    seed: int,
    *,
    onset: float = 0.0,
    seconds: float = 50.0,
    command: FloatArray | None = None,
) -> Log:
    """A drive of the reference vehicle, which shares no code with this, at 20 Hz."""
    command = command_over(np.arange(round(seconds * 20)) / 20) if command is None else command
    run = simulate(
        Car(),
        Recorded(command, start_speed=25.0),
        seconds=len(command) / 20,
        rate_hz=20,
        effects=effects,
        onset=onset,
        seed=seed,
    )
    return Log.from_arrays(time=run.time, accel_cmd=run.command, accel=run.accel, speed=run.speed)


def _search(log: Log, effects: Sequence[type[Effect]], path: Path | None = None, **options: object) -> SearchResult:
    return Search([log], plant(), effects=effects, checkpoint=path, **options).run()  # type: ignore[arg-type]


def _evidence(race: SearchResult) -> dict[str, float]:
    """Over none [nats], by name."""
    return {f.name: f.log_evidence - race.none.log_evidence for f in race.found}


def _fitted(path: Path) -> list[str]:
    """What was fitted with noise of its own, in turn."""
    return [entry["name"] for entry in json.loads(path.read_text(encoding="utf-8"))["content"]["fits"]]


def _sound(race: SearchResult) -> None:
    """Whatever the search: one find for each name, most evidence first."""
    names = [f.name for f in race.found]
    assert len(set(names)) == len(names)
    evidence = [f.log_evidence for f in race.found]
    assert evidence == sorted(evidence, reverse=True)
    assert np.isfinite(evidence).all()


@pytest.mark.statistical
def test_none_stays_none(rotating_seed: int) -> None:
    race = _search(_log({}, rotating_seed), [DeadTime, ConstantResistance, *SENSOR])
    _sound(race)
    # a likelihood ratio against what is true exceeds x nats in exp(-x) of all drives
    assert max(_evidence(race).values()) < 12
    assert race.complete
    assert {f.name for f in race.found} >= {"none", "dead_time", "constant_resistance", "sensor_bias", "sensor_scale"}
    assert race.none.values["T_L"] == pytest.approx(Car().T_L, rel=0.2)


@pytest.mark.statistical
def test_a_pair_is_found(rotating_seed: int) -> None:
    log = _log({"dead_time": {"delay_s": 0.25}, "sensor_bias": {"bias_mps2": 0.15}}, rotating_seed)
    race = _search(log, [DeadTime, ConstantResistance, *SENSOR])
    _sound(race)
    assert race.best.name == "dead_time+sensor_bias"
    assert race.best.onset is None
    assert race.best.values["dead_time.delay_s"] == pytest.approx(0.25, abs=0.04)
    assert race.best.values["sensor_bias.bias_mps2"] == pytest.approx(0.15, abs=0.04)
    evidence = _evidence(race)
    singles = [evidence[n] for n in ("dead_time", "sensor_bias")]
    assert evidence[race.best.name] > max(singles) + 50
    # and no pair is looked for unless asked
    alone = _search(log, [DeadTime, SensorBias], pairs=False)
    assert {f.name for f in alone.found} == {"none", "dead_time", "sensor_bias"}


@pytest.mark.statistical
def test_hypotheses_far_behind_in_screening_are_not_refitted(tmp_path: Path, rotating_seed: int) -> None:
    """The plain cause and what comes near it get noise of their own; what does nothing keeps its first figure."""
    path = tmp_path / "fits.json"
    log = _log({"sensor_bias": {"bias_mps2": 0.25}}, rotating_seed)
    told: list[tuple[str, int, int]] = []
    race = _search(log, [SensorBias, DeadTime, Saturation], path, pairs=False, progress=lambda *step: told.append(step))
    _sound(race)
    fitted = _fitted(path)
    assert fitted[0] == "none"
    assert set(fitted) == {"none", "sensor_bias"}
    evidence = _evidence(race)
    assert evidence["sensor_bias"] > 100
    # scored under the noise of the bare car
    behind = [f for f in race.found if f.name in ("dead_time", "saturation")]
    assert len(behind) == 2
    assert all(f.noise is race.none.noise for f in behind)
    assert all(f.onset is None for f in behind)
    assert [of for what, _, of in told if what == "best effects"] == [1]
    assert [(done, of) for what, done, of in told if what == "single effects"] == [(0, 3), (1, 3), (2, 3)]


def test_the_best_of_equal_names_is_kept(fresh_seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def three(self: Search, record: Record, none: FittedModel) -> list[FittedModel]:
        more = [replace(none, name="twice", log_evidence=none.log_evidence + x, grade_rms=x) for x in (2.0, 5.0, 3.0)]
        return [none, *more, replace(none, name="behind", log_evidence=none.log_evidence - 4)]

    monkeypatch.setattr(Search, "_singles", three)
    race = _search(_log({}, fresh_seed, seconds=20.0), [SensorBias], pairs=False)
    assert [f.name for f in race.found] == ["twice", "none", "behind"]
    assert race.best.grade_rms == 5.0


def test_pairs_are_searched_once_where_other_rows_turn_out_as_outliers(
    fresh_seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(name: str) -> None:
        own = getattr(Search, name)

        def call(self: Search, *given: object) -> object:
            calls.append(name)
            return own(self, *given)

        monkeypatch.setattr(Search, name, call)

    counted("_singles")
    counted("_pairs")
    monkeypatch.setattr(Search, "_other_tails", lambda self, raw, found, before: self._tails(raw, found[0]))
    _search(_log({}, fresh_seed, seconds=20.0), [SensorBias, EFFECTS["outliers"]])
    assert calls == ["_singles", "_singles", "_pairs"]


def _steps(rng: np.random.Generator, seconds: float = 50.0) -> FloatArray:
    """A demand that moves twice a second, so that a lost message shows."""
    return np.repeat(rng.uniform(-1.5, 1.5, round(2 * seconds)), 10)


@pytest.mark.statistical
def test_lost_messages_on_top_of_a_single_effect(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    effects = {"sensor_bias": {"bias_mps2": 0.2}, "command_hold": {"hold_fraction": 0.4}}
    log = _log(effects, int(rng.integers(2**31)), command=_steps(rng))
    race = _search(log, [SensorBias, CommandHold])
    _sound(race)
    names = {f.name: f for f in race.found}
    assert race.best.name == "command_hold+sensor_bias"
    assert race.best.losses is not None
    # estimated too low: lag and noise fitted without losses absorb a part of their effect
    assert 0.1 < race.best.losses.fraction < 0.6
    evidence = _evidence(race)
    assert evidence[race.best.name] == pytest.approx(evidence["sensor_bias"] + race.best.losses.evidence)
    assert race.best.losses.evidence > 5
    # everything else is the single effect's
    assert race.best.values == names["sensor_bias"].values
    assert names["sensor_bias"].losses is None
    # alone, they are far behind
    assert evidence["command_hold"] < evidence["sensor_bias"]


@pytest.mark.statistical
def test_lost_messages_alone(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    log = _log({"command_hold": {"hold_fraction": 0.4}}, int(rng.integers(2**31)), command=_steps(rng))
    race = _search(log, [CommandHold])
    assert [f.name for f in race.found] == ["command_hold", "none"]
    assert _evidence(race)["command_hold"] > 5
    # and where none are lost, none are found
    race = _search(_log({}, int(rng.integers(2**31)), command=_steps(rng)), [CommandHold])
    assert _evidence(race)["command_hold"] < 12


@pytest.mark.statistical
def test_lost_messages_alone_are_tested_where_they_resemble_a_delay(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    log = _log({"command_hold": {"hold_fraction": 0.4}}, int(rng.integers(2**31)), command=_steps(rng))
    race = _search(log, [DeadTime, CommandHold])
    assert race.best.name in ("command_hold", "command_hold+dead_time")
    assert "command_hold" in {f.name for f in race.found}


def test_an_effect_that_the_log_cannot_show_is_not_tried(fresh_seed: int) -> None:
    log = _log({}, fresh_seed, seconds=30.0)
    blind = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=log.accel)
    race = _search(blind, [AerodynamicDrag, SensorBias])
    assert {f.name for f in race.found} == {"none", "sensor_bias"}
    moving = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, speed=log.speed)
    race = _search(moving, [AerodynamicDrag, SensorBias], pairs=False)
    assert {f.name for f in race.found} == {"none", "aerodynamic_drag"}


def test_a_search_out_of_time_reports_it(fresh_seed: int) -> None:
    race = _search(_log({}, fresh_seed, seconds=30.0), [SensorBias, DeadTime], budget_s=0.0)
    assert not race.complete
    assert [f.name for f in race.found] == ["none"]


@pytest.mark.statistical
def test_a_cause_that_sets_in_is_found_with_its_onset(rotating_seed: int) -> None:
    log = _log({"dead_time": {"delay_s": 0.3}}, rotating_seed, onset=30.0)
    race = _search(log, [DeadTime, SensorScale], pairs=False)
    assert race.best.name == "dead_time"
    assert race.best.onset is not None
    record = race.best.hypothesis.record
    assert abs(float(record.time[record.source[race.best.onset]]) - 30) < 3.6
    assert race.best.values["dead_time.delay_s"] == pytest.approx(0.3, abs=0.05)
