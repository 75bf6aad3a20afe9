"""The expected information of a manoeuvre, and which one is chosen."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.experiment import Limits, ManoeuvrePrediction, information, library, next_experiment, write_table
from avtorch.experiment.prediction import responses
from avtorch.gap import Effect, plant
from avtorch.gap.effects.aerodynamic_drag import AerodynamicDrag
from avtorch.gap.effects.constant_resistance import ConstantResistance
from avtorch.gap.effects.dead_band import DeadBand
from avtorch.gap.effects.gain_change import GainChange
from avtorch.gap.effects.road_grade import RoadGrade
from avtorch.gap.effects.sensor_bias import SensorBias
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import band_covariance
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.gap_size import GapSize
from avtorch.gap.result.hypotheses import Candidate
from avtorch.gap.result.log_facts import LogFacts
from avtorch.gap.result.predictive_model import NoiseSpectrum, PredictiveModel
from avtorch.gap.result.sentences import to_drive
from tests.bars import BAR
from tests.gap.records import log_of
from tests.gap.verdicts import verdict_of

BOTH = ("accel", "speed")


def usual_noise() -> NoiseSpectrum:
    """Forces of 0.04 m/s² within 0.35 s and 0.01 m/s² within 3 s, sensors' noise of 0.06 m/s² and 0.03 m/s, by rows of
    0.05 s."""
    frequency = np.geomspace(0.02, 9.9, 80)
    turn, dt = 2 * np.pi * frequency, 0.05
    force = sum(2 * sd**2 * time / (1 + (turn * time) ** 2) for sd, time in ((0.04, 0.35), (0.01, 3.0))) / dt
    covariance = np.repeat(force, 4).reshape(-1, 2, 2)
    covariance[:, 0, 0] += 0.06**2
    covariance[:, 1, 1] += (turn * 0.03) ** 2
    return NoiseSpectrum(BOTH, frequency, covariance, 10.0)


NOISE = usual_noise()


def contender(
    effects: list[Effect], *, spread: float = 0.01, rng: np.random.Generator, noise: NoiseSpectrum = NOISE
) -> PredictiveModel:
    """Of a plant, its parameters known to a share of `spread`."""
    own = plant(effects, T_L=0.4, K_L=0.9)
    belief = {k: float(v) * np.exp(spread * rng.standard_normal(64)) for k, v in own.values().items() if v.dim() == 0}
    name = "+".join(sorted(e.name for e in effects)) or "none"
    grade = 0.02 if name == "road_grade" else None
    return PredictiveModel(name, own, belief, noise, grade_rms=grade)


def left(rivals: list[PredictiveModel], shares: list[float]) -> Diagnosis:
    """A diagnosis that leaves these."""
    each = [Candidate(r.name, p, 0.0) for r, p in zip(rivals, shares, strict=True)]
    each += [Candidate(n, 0.01, None) for n in ("none", "unknown") if n not in {r.name for r in rivals}]
    log = LogFacts(rows=1200, segments=1, seconds=60.0, rate_hz=20.0, signals=("accel_cmd", *BOTH))
    verdict = verdict_of(each, aliases=lambda _: [r.name for r in rivals])
    return Diagnosis(log, {}, GapSize(True), tuple(each), verdict, contenders=tuple(rivals))


def sensors_noise(data: DriveData, rows: int, rng: np.random.Generator) -> FloatArray:
    """Coefficients of white noise of 0.06 m/s² and 0.02 m/s, of means of `rows` rows."""
    each = [sd / np.sqrt(rows) * rng.standard_normal(len(data.time)) for sd in (0.06, 0.02)]
    return data.transform(data.channel_rows(*each))


@pytest.mark.statistical
@pytest.mark.parametrize(("rate_hz", "group"), [(20, 1), (60, 3), (200, 10)])
def test_the_noise_of_a_log_is_carried_over_to_a_manoeuvres_rows(rate_hz: int, group: int, rotating_seed: int) -> None:
    """Means have an n-th of the noise, and a difference over longer steps sees less of what is fast."""
    rng = np.random.default_rng(rotating_seed)
    log, manoeuvre = (DriveData.of(log_of(seconds=300.0, rate_hz=rate, noise=None)) for rate in (rate_hz, 20))
    h = Hypothesis(log)
    h.covariance = band_covariance(log, sensors_noise(log, log.group, rng))
    told = NoiseSpectrum.of(h).at(manoeuvre, group)
    drawn = band_covariance(manoeuvre, sensors_noise(manoeuvre, group, rng))
    bands, edges = manoeuvre.band_size, manoeuvre.band_edges[:-1]
    told = np.add.reduceat(told, edges, axis=0) / np.diff(manoeuvre.band_edges)[:, None, None]
    # one value is told of a band: the first ones are too wide for what rises so steeply, and at the end of the last one
    # a difference sees nothing
    fast = (manoeuvre.frequency[edges] > 0.5) & (edges < edges[-1])
    for c in (0, 1):
        off = np.log(told[fast, c, c] / drawn[fast, c, c])
        # both are estimated, of about as many coefficients
        assert (np.abs(off) < BAR * np.sqrt(4 / bands[fast]) + 0.02).all()


@pytest.mark.statistical
def test_margin_is_half_the_square_of_the_distance(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    m = [x for x in library() if x.name.startswith("holds")][:1]
    rivals = [contender([], spread=1e-6, rng=rng), contender([SensorBias(0.02)], spread=1e-6, rng=rng)]
    foretold = [ManoeuvrePrediction(r, m, BOTH, 1, 64) for r in rivals]
    law = foretold[0].law(0)
    away = law.whitened((foretold[1].law(0).mean - law.mean)[None])
    distance = float(np.linalg.norm(away))
    expected = information(foretold, 0, [0.5, 0.5], seed=rotating_seed)
    # the log odds of 32 examples are normal with this mean and a standard deviation of `distance`; a median of them
    assert expected.margin == pytest.approx(distance**2 / 2, abs=BAR * 1.26 * distance / np.sqrt(32))


def test_the_same_cause_twice_is_never_distinguished(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    one = contender([DeadBand(0.1)], rng=rng)
    m = library()[:1]
    expected = information([ManoeuvrePrediction(one, m, BOTH, 1, 32)] * 2, 0, [0.5, 0.5])
    assert expected.nats == pytest.approx(0.0, abs=1e-9)
    assert expected.truth_probability == pytest.approx(0.5)


@pytest.mark.statistical
def test_a_resistance_and_a_bias_differ_in_the_speed_alone(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    rivals = [contender([ConstantResistance(0.1)], rng=rng), contender([SensorBias(-0.1)], rng=rng)]
    m = [x for x in library() if x.name.startswith("steps")][:1]
    both = information([ManoeuvrePrediction(r, m, BOTH, 1, 32) for r in rivals], 0, [0.5, 0.5])
    alone = information([ManoeuvrePrediction(r, m, ("accel",), 1, 32) for r in rivals], 0, [0.5, 0.5])
    assert both.nats == pytest.approx(np.log(2), abs=1e-6)
    assert alone.nats < 0.05


@pytest.mark.statistical
@pytest.mark.slow
def test_of_the_sure_manoeuvres_the_gentlest_is_chosen(rotating_seed: int) -> None:
    rng = np.random.default_rng(rotating_seed)
    found = left([contender([], rng=rng), contender([DeadBand(0.1)], rng=rng)], [0.6, 0.3])
    experiment = next_experiment(found)
    assert experiment is not None
    assert experiment.separates == ("none", "dead_band")
    assert 0 < experiment.information.nats <= experiment.entropy + 1e-9
    assert experiment.information.truth_probability > 0.99
    sure = {name: i for name, i in experiment.every.items() if i.margin >= 12}
    efforts = {m.name: m.effort for m in library() if m.name in sure}
    assert efforts[experiment.manoeuvre.name] <= min(efforts.values()) + 0.1
    answer = experiment.to_dict()
    assert answer["expected_information_nats"] == experiment.information.nats
    assert answer["seconds"] <= 60.0


def test_limits_hold_for_the_speed_that_the_car_will_drive(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    rivals = [contender([ConstantResistance(0.2)], rng=rng), contender([], rng=rng)]
    limits = Limits(speed_min=3, speed_max=18, road=700, seconds=45)
    experiment = next_experiment(left(rivals, [0.6, 0.3]), limits)
    assert experiment is not None
    m = experiment.manoeuvre
    speed = responses(rivals[0], [m], slice(None)).speed.mean((0, 1)).numpy()
    assert m.metres <= 700
    assert m.speed.min() >= 3
    np.testing.assert_allclose(speed, m.speed, atol=0.3)
    # a push compensates the resistance: the speed still returns
    assert m.speed[-1] == pytest.approx(m.speed[0], abs=0.5)


def test_an_unknown_road_widens_the_prediction(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    hilly = contender([RoadGrade(0.02)], rng=rng)
    m = library()[:1]
    foretold = ManoeuvrePrediction(hilly, m, BOTH, 1, 32)
    law = foretold.law(0)
    flat = ManoeuvrePrediction(replace(hilly, grade_rms=None), m, BOTH, 1, 32).law(0)
    assert len(law.spread) > len(flat.spread)
    push = 9.81 * 0.02 * np.sin(0.02 * m[0].time)
    pushed = law.mean + foretold.coefficients(np.stack([push, np.cumsum(push) * 0.05])[None])
    assert law.log_density(pushed)[0] > flat.log_density(pushed)[0] + 20


def test_a_gain_that_has_changed_stays_changed(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    changed = contender([GainChange(0.7, change_s=200.0)], spread=1e-9, rng=rng)
    m = library()[:1]
    accel = responses(changed, m, slice(0, 2)).accel[0, 0].numpy()
    plain = responses(contender([], spread=1e-9, rng=rng), m, slice(0, 2)).accel[0, 0].numpy()
    np.testing.assert_allclose(accel, 0.7 * plain, atol=1e-6)


@pytest.mark.slow
def test_the_table_is_written_and_an_old_one_goes(tmp_path: Path, fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    experiment = next_experiment(left([contender([], rng=rng), contender([DeadBand(0.1)], rng=rng)], [0.6, 0.3]))
    (path,) = write_table(experiment, tmp_path)
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert experiment is not None
    assert list(rows[0]) == ["time", "accel_cmd", "speed_expected"]
    np.testing.assert_allclose(
        [float(r["accel_cmd"]) for r in rows], experiment.manoeuvre.command, rtol=1e-5, atol=1e-9
    )
    assert write_table(None, tmp_path) == []
    assert not path.exists()


@pytest.mark.slow
def test_a_slow_car_is_offered_what_it_can_drive(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    found = left([contender([], rng=rng), contender([SensorBias(0.3)], rng=rng)], [0.6, 0.3])
    slow = replace(found.log, speeds=(0.4, 3.5), commands=(-1.3, 4.9))
    experiment = next_experiment(replace(found, log=slow))
    assert experiment is not None
    assert 0.2 <= experiment.manoeuvre.speed.min() < experiment.manoeuvre.speed.max() <= 3.5 * 1.05
    answer = experiment.to_dict()
    assert answer["limits"]["source"] == "from the log"
    assert answer["limits"]["speed_max"] == pytest.approx(3.655)
    (line,) = to_drive(replace(found, next_experiment=answer))
    assert "Limits, from the log: 0.24 to 3.66 m/s, -1.6 to 5.21 m/s²." in line


@pytest.mark.slow
def test_drag_on_a_fast_road_leaves_manoeuvres_that_come_back(fresh_seed: int) -> None:
    """The effect of drag depends on the speed that remains after compensation."""
    rng = np.random.default_rng(fresh_seed)
    rivals = [contender([AerodynamicDrag(2.7e-4)], rng=rng), contender([ConstantResistance(0.2)], rng=rng)]
    limits = Limits(23, 29.6, -1.3, 1.3)
    experiment = next_experiment(left(rivals, [0.6, 0.3]), limits)
    assert experiment is not None
    assert len(experiment.every) > 0.5 * len(library(limits))
    speed = responses(rivals[0], [experiment.manoeuvre], slice(None)).speed.mean((0, 1)).numpy()
    assert abs(speed[-1] - speed[0]) < 0.3


def test_nothing_confused_needs_no_experiment(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    assert next_experiment(left([contender([], rng=rng)], [0.9])) is None


def test_limits_without_any_manoeuvre_are_an_error(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    found = left([contender([], rng=rng), contender([DeadBand(0.1)], rng=rng)], [0.6, 0.3])
    with pytest.raises(InputError, match="limits: no manoeuvre"):
        next_experiment(found, Limits(speed_min=20, speed_max=30, road=150, seconds=60))
