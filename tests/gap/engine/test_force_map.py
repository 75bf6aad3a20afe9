"""Force maps: laws of their curves, and cars with a bent command, whose map is a part without a name.

A car of command w is one of command u with the map F(u) = K (u + c u |u|) in front of it, where u + c u |u| = w: the
command's column is rewritten, and every sample of the response stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from avtorch import diagnose
from avtorch.arrays import FloatArray
from avtorch.gap import DeadTime, Effect
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.evidence import evaluate_evidence
from avtorch.gap.engine.force_base import prices, with_force_map
from avtorch.gap.engine.force_map import CURVES, MAP_SIZES, ForceMap, MapForm, map_forms, size_log_prior
from avtorch.gap.engine.gauss_newton import force_columns, linearised
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.inference import Inference, infer
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.engine.search import tried
from avtorch.gap.result.hypotheses import map_size
from avtorch.io import Log
from tests.gap.cars import log_of

BEND, LAG, GAIN, DELAY = 0.5, 0.35, 0.95, 0.3
"""The bend [s²/m] of commands of 0.7 m/s², as of 0.15 where they are thrice that; lag [s], gain, dead time [s]."""
FEW = ("dead_time", "constant_resistance", "sensor_bias")


def bent(log: Log) -> Log:
    """The log of the same car with a cubic map in front of it."""
    assert log.accel_cmd is not None
    w = log.accel_cmd
    return replace(log, accel_cmd=np.sign(w) * (np.sqrt(1 + 4 * BEND * np.abs(w)) - 1) / (2 * BEND))


@cache
def found(car: tuple[Effect, ...] = (), bend: bool = True, seed: int = 1) -> Inference:
    log = log_of(car, seconds=90.0, seed=seed)
    return infer(DriveData.of(bent(log) if bend else log), effects=FEW, most=2)


@cache
def based(seconds: float = 60.0, bend: bool = True, channels: Sequence[str] = ("accel", "speed")) -> Hypothesis:
    """The base without a map."""
    log = log_of(seconds=seconds, seed=2)
    log = replace(log, accel=log.accel if "accel" in channels else None)
    alone = len(channels) == 1
    data = DriveData.of(bent(log) if bend else log)
    h = base_fit(data.below(1.3) if alone else data, alone=alone)
    h.base = h
    return evaluate_evidence(h)


# curves ---------------------------------------------------------------------------------------------------------------
def test_a_map_is_linear_between_knots_and_held_outside() -> None:
    m = ForceMap(np.array([-1.0, 0.0, 2.0]), np.array([5.0, 15.0]), np.array([[1.0, 3.0], [0.0, 0.0], [4.0, 8.0]]), 0.1)
    u, v = np.array([-1.0, 1.0, 1.0, 2.0, 9.0, -9.0]), np.array([5.0, 5.0, 10.0, 15.0, 40.0, 0.0])
    np.testing.assert_allclose(m(u, v), [1.0, 2.0, 3.0, 8.0, 8.0, 1.0])


def test_demands_are_the_map_on_the_drive(fresh_seed: int) -> None:
    data = based().data
    for form in map_forms(data):
        b = np.random.default_rng(fresh_seed).normal(size=form.count)
        np.testing.assert_allclose(form.force_map(b)(data.command, data.smooth_speed), b @ form.demands, atol=1e-9)
        np.testing.assert_allclose(b @ form.gram @ b, ((b @ form.demands) ** 2).mean())


def test_curves_have_the_kernels_variance_where_the_car_drove() -> None:
    """Near the middle of command and speed 1 + k(v) + k(u) + k(u) k(v) / 2 is 3.5, less where knots are far apart."""
    resistance, force = map_forms(based().data)
    data = based().data
    middle = np.abs(data.command - np.median(data.command)) < 0.1 * data.command.std()
    middle &= np.abs(data.smooth_speed - np.median(data.smooth_speed)) < 0.1 * data.smooth_speed.std()
    for form, variance in ((resistance, 2.0), (force, 3.5)):
        own = (form.demands[:, middle] ** 2).sum(0).mean() / form.scale**2
        assert 0.8 * variance < own < 1.02 * variance
    assert resistance.count < force.count < 54
    assert np.ptp(resistance.tables, axis=1).max() == 0.0  # of no command


def test_probabilities_of_sizes_vanish_with_the_size() -> None:
    log = size_log_prior()
    assert np.exp(log).sum() < 1.0
    assert MAP_SIZES[int(np.argmax(log))] == pytest.approx(0.2)
    assert log[0] < log[2] - 1.0


def test_no_map_without_a_speed() -> None:
    log = replace(log_of(seconds=30.0), speed=None)
    assert map_forms(DriveData.of(log)) == []


# in the command -------------------------------------------------------------------------------------------------------
def _mapped() -> tuple[Hypothesis, MapForm]:
    h = based().copy()
    form = map_forms(h.data)[-1]
    h.force, h.force_coefficients = form, 0.05 * np.ones(form.count)
    return h.evaluate(), form


def test_the_gain_scales_the_command_alone() -> None:
    h, form = _mapped()
    more = h.values.copy()
    more[1] *= 2.0
    for values in (h.values, more):
        force = values[1] * h.command(values) - values[1] * h.data.command
        np.testing.assert_allclose(force, h.force_coefficients @ form.demands, atol=1e-12)


def test_lost_commands_bring_their_own_force() -> None:
    h, form = _mapped()
    h.lost = ((100, 120),)
    speed, held = h.data.smooth_speed[100:120], np.full(20, h.data.command[99])
    own = form.force_map(h.force_coefficients)(held, speed)
    np.testing.assert_allclose(h.command()[100:120], held + own / h["K_L"])


def test_columns_are_the_slopes_of_the_response(fresh_seed: int) -> None:
    h, _ = _mapped()
    step = 0.02 * np.random.default_rng(fresh_seed).normal(size=len(h.force_coefficients))
    moved = h.copy()
    moved.force_coefficients = h.force_coefficients + step
    change = np.tensordot(step, force_columns(h), 1)
    np.testing.assert_allclose(moved.response() - h.predicted, change, atol=1e-6 * np.abs(change).max())
    slopes, precision, pull = linearised(h, h.free)
    assert len(slopes) == len(precision) == len(pull) == len(h.free) + len(step)


# evidence -------------------------------------------------------------------------------------------------------------
def test_a_map_without_need_costs_what_it_could_have_been() -> None:
    resistance, force = prices(based(bend=False))
    assert resistance.nats < -10.0
    assert force.nats < -15.0
    assert not resistance.gains
    assert not force.gains


@pytest.mark.parametrize("channels", [("accel", "speed"), ("speed",)], ids="+".join)
def test_curves_cannot_fit_a_band_of_few_coefficients_to_nothing(channels: tuple[str, ...]) -> None:
    """In 24 s a band of one bin has as many coefficients as there are frames, fewer than there are curves."""
    h = based(24.0, bend=False, channels=channels)
    form = map_forms(h.data)[-1]
    assert form.count > h.data.band_size.min()
    m = with_force_map(h, form)
    assert np.isfinite(m.evidence)
    assert m.evidence < h.evidence + 3.0  # odds of one in twenty
    before, after = (np.linalg.slogdet(x.covariance)[1] for x in (h, m))
    assert (after - before).min() > -6.0


def test_a_bent_command_is_worth_a_map() -> None:
    h = based()
    (_, _), (form, nats) = prices(h)
    m = with_force_map(h, form)
    assert nats > 5.0
    assert m.evidence > h.evidence + nats
    assert m.evidence == pytest.approx(evaluate_evidence(m.evaluate()).evidence, abs=0.01)


def test_what_a_map_takes_up_is_not_tried_beside_it() -> None:
    search = found().search
    (base,) = (h for h in search.map_bases if h.force is not None and h.force.name == "F(u, v)")
    plain, mapped = ({e.name for e in tried(h, search.effects)} for h in (search.base, base))
    assert plain - mapped == {"constant_resistance"}
    assert not {e for h in search.visited.values() if h.force is not None for e in h.effects} & set(CURVES)


# answers --------------------------------------------------------------------------------------------------------------
def _curve(found: Inference) -> tuple[FloatArray, FloatArray]:
    """Force (row,) of the likeliest hypothesis with a map, and the true one, [m/s²]."""
    h = max((x.hypothesis for x in found.average.examined), key=lambda h: h.score)
    force, u = h.force_map, h.data.command
    assert force is not None
    return h["K_L"] * u + force(u, h.data.smooth_speed), GAIN * (u + BEND * u * np.abs(u))


def test_a_bent_command_is_a_part_without_a_name() -> None:
    average = found().average
    assert average.force_maps["F(u, v)"] > 0.9
    assert average.label == "unknown"
    told, true = _curve(found())
    assert np.abs(told - true).mean() < 0.1 * np.abs(true - GAIN * found().data.command).mean() + 0.02
    h = max((x.hypothesis for x in found().average.examined), key=lambda h: h.score)
    assert h["T_L"] == pytest.approx(LAG, abs=0.04)
    size = map_size(h)
    line = np.polyfit(h.data.command, told, 1)[0]
    assert size.mean > 0.5 * np.std(told - line * h.data.command)


def test_a_dead_time_in_front_of_a_map_has_its_name() -> None:
    average = found((DeadTime(DELAY),)).average
    assert average.force_maps["F(u, v)"] > 0.9
    assert average.label == "dead_time"
    h = average.best["dead_time"].examined.hypothesis
    assert h["dead_time"] == pytest.approx(DELAY, abs=0.06)
    assert h["T_L"] == pytest.approx(LAG, abs=0.06)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_true_command_has_no_map(seed: int) -> None:
    plain = found(bend=False, seed=seed)
    assert plain.search.map_bases == []
    assert plain.average.force_maps == {}


def test_an_answer_says_its_parts() -> None:
    log = bent(log_of([DeadTime(DELAY)], seconds=90.0, seed=1))
    answer = diagnose(log, effects=["dead_time"], pairs=False)
    delay, force, *faint = answer.to_dict()["parts"]
    assert all(part["name"] is None and part["probability"] < 0.5 for part in faint)
    assert (delay["name"], delay["family"], delay["form"]) == ("dead_time", "dynamics", None)
    assert (force["name"], force["family"], force["form"]) == (None, "force map", "F(u, v)")
    assert force["probability"] > 0.9
    assert 0 < force["size_mps2"]["q05"] < force["size_mps2"]["mean"] < force["size_mps2"]["q95"]
    assert "force map" in answer.verdict.why
    # the simulator that comes back carries a free form, or what it leaves does not pass for noise
    assert answer.budget is not None
    assert answer.free_form is not None or answer.budget.unexplained.rest(answer.budget.material) != "noise"
