"""The free form of a repaired simulator, fitted to free runs and judged on blocks left out."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from scipy.signal import lfilter

from avtorch.gap import ConstantResistance, ForceTable, GapPlant, Gust, ResistanceCurve, SimulatorInput, plant
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.recorder import base_fit
from avtorch.gap.result import held_out
from avtorch.gap.result.free_form import FittedForm, Sizes, fitted_form
from avtorch.gap.result.held_out import Scores
from avtorch.gap.result.output_error import Coefficients, Rows, Runs
from avtorch.io import Log
from tests.gap.cars import log_of

MAP = ForceTable((-2.0, 0.0, 2.0), (5.0, 30.0), ((1.0, 0.6), (0.0, 0.0), (-0.2, -1.2)))
DRAG = ResistanceCurve((5.0, 30.0), (-0.1, -0.5))


def form_of(log: Log, baseline: GapPlant | None = None) -> FittedForm | None:
    base = fit(base_fit(DriveData.of(log)))
    return fitted_form(base, plant([]) if baseline is None else baseline, base, named=False)


@cache
def found() -> FittedForm:
    form = form_of(log_of([MAP, DRAG], seconds=120.0, seed=1))
    assert form is not None
    return form


def test_a_car_with_a_map_is_foretold_better_with_one() -> None:
    form = found()
    assert form.score < -1.0
    car = form.beside(plant([], T_L=0.3))
    assert GapPlant.from_toml(car.to_toml()).to_toml() == car.to_toml()
    assert 0.1 < float(car.T_L) < 0.6


def test_a_car_without_one_comes_back_without_it() -> None:
    form = form_of(log_of([], seconds=120.0, seed=1))
    assert form is None or form.score > -0.5


def test_what_a_block_tells_does_not_teach_it() -> None:
    form = found()
    rows = [slice(0, 400)]
    apart, whole = form.without(rows), form.without([])
    assert 0.0 < float(np.abs(apart - whole).max()) < 1.0


def test_slopes_of_free_runs_are_their_derivatives() -> None:
    rng = np.random.default_rng(0)
    n, starts = 200, np.zeros(200, bool)
    starts[[0, 100]] = True
    command, speed = rng.normal(size=n), 10 + np.cumsum(rng.normal(size=n)) * 0.1
    knots = (np.array([-1.0, 0.0, 1.0]), np.array([8.0, 10.0, 12.0]))
    runs, named = Runs.of(Rows(0.1, command, speed, np.arange(n), starts, *knots), None, 10.0, 1.5), 0.1 * command
    x = 0.3 * rng.normal(size=13)
    _, slopes = runs.drive(named, 0.3, Coefficients.of(x, (3, 3)))
    for k in range(len(x)):
        ends = []
        for sign in (-1, 1):
            moved = x.copy()
            moved[k] += sign * 1e-6
            ends.append(runs.drive(named, 0.3, Coefficients.of(moved, (3, 3)))[0])
        assert slopes[:, k] == pytest.approx((ends[1] - ends[0]) / 2e-6, abs=1e-4)


def test_a_table_costs_more_without_a_resistance() -> None:
    assert Sizes(0.2, 0.2).nats < Sizes(0.0, 0.2).nats
    assert not Sizes(0.0, 0.0).any


@pytest.mark.parametrize(
    ("named", "free", "gains"), [(0.5, 0.3, True), (0.5, 0.6, False), (1.4, 1.2, False), (1.4, 0.9, True)]
)
def test_a_free_form_that_loses_in_the_budgets_runs_is_not_handed_back(named: float, free: float, gains: bool) -> None:
    """Against names alone, and against the baseline; channels count alike, whatever their units."""
    scale = np.array([[4.0, 4.0], [0.01, 0.03]])  # (channel, block)
    base, names, carried = (Scores(x * scale, np.zeros(2)) for x in (1.0, named, free))
    assert held_out.gains(carried, base, names) == gains
    assert held_out.gains(carried, base, None) == (free < 1.0)


def test_the_gust_beside_a_free_form_is_not_handed_back() -> None:
    """The form takes a part of it; what is left is not known."""
    back = found().beside(plant([Gust(0.3, 5.0), ConstantResistance(0.1)]))
    assert [e.name for e in back.effects if e.name in ("gust", "constant_resistance")] == ["constant_resistance"]


def test_a_gain_of_free_runs_is_handed_back_where_the_evidences_errs(fresh_seed: int) -> None:
    """Only slow commands move this car; the evidence, which looks at all of them, finds a third of its gain or less."""
    rng = np.random.default_rng(fresh_seed)
    time = 0.05 * np.arange(2400)
    slow = np.sin(0.3 * time) + 0.7 * np.sin(0.11 * time)
    lost = np.repeat(rng.normal(0.0, 1.5, 1200), 2)  # of a motor that does not follow them
    accel = lfilter([0.1], [1, -0.9], slow)
    speed = 20 + 0.05 * np.cumsum(accel) + 0.01 * rng.normal(size=len(time))
    log = Log.from_arrays(
        time=time, accel_cmd=slow + lost, accel=accel + 0.05 * rng.normal(size=len(time)), speed=speed
    )
    form = form_of(log)
    assert form is not None
    base = form.hypothesis
    assert base["K_L"] < 0.5
    back = form.beside(plant([], T_L=base["T_L"], K_L=base["K_L"]))
    # of the commands that it follows alone, as a gain or a map; what it does not follow is noise of the command, and
    # makes a regression's gain a little small
    drive = SimulatorInput(*map(torch.as_tensor, (time, slow, np.full_like(time, 20.0))))
    there = back.response(drive).accel.numpy()
    assert abs(float(there @ accel / (accel @ accel)) - 1.0) < 0.25 * abs(base["K_L"] - 1.0)


def test_a_speed_that_falls_as_the_command_rises_has_no_free_form() -> None:
    """As in the second half of a truck's drive on a grade: no car has a negative gain, and no table makes up for it."""
    time, rng = 0.05 * np.arange(2400), np.random.default_rng(1)
    command = np.sin(0.3 * time) + 0.7 * np.sin(0.11 * time)
    accel = lfilter([0.02], [1, -0.98], rng.normal(0.0, 2.0, 2400))  # a road; or else the sign is refused as wrong
    accel -= 0.15 * lfilter([0.1], [1, -0.9], command)
    speed = 20 + 0.05 * np.cumsum(accel) + 0.01 * rng.normal(size=len(time))
    log = Log.from_arrays(time=time, accel_cmd=command, accel=accel + 0.05 * rng.normal(size=len(time)), speed=speed)
    assert form_of(log) is None


def test_a_simulator_that_has_a_force_map_gets_no_second_one() -> None:
    assert form_of(log_of([MAP, DRAG], seconds=60.0), plant([MAP])) is None
