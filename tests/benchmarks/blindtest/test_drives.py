"""Drives are plausible: no collision, no runaway, commands within limits, the stated manoeuvre."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.errors import InputError
from benchmarks.blindtest.car import Car, draw_car
from benchmarks.blindtest.drives import ACCEL_MAX_MPS2, ACCEL_MIN_MPS2, MANOEUVRES, DrivePlan, draw_drive, with_stops
from benchmarks.blindtest.vehicle import simulate


@pytest.mark.slow
@pytest.mark.parametrize("manoeuvre", MANOEUVRES)
def test_ordinary_drives(manoeuvre: str) -> None:
    rng = np.random.default_rng(3)
    for seed in range(4):
        made = DrivePlan(manoeuvre, 60.0, 25, seed)  # type: ignore[arg-type]
        pilot = made.pilot()
        run = simulate(draw_car(rng), pilot, seconds=60.0, rate_hz=25, seed=seed)
        assert run.command.min() >= ACCEL_MIN_MPS2 - 0.2
        assert run.command.max() <= ACCEL_MAX_MPS2
        assert run.true_speed.max() < 42
        assert run.command.std() > 0.05
        assert getattr(pilot, "nearest", 1.0) > 0
        assert np.mean(run.true_speed > 0.3) > 0.5


def test_manoeuvres_differ_as_their_names_say() -> None:
    def mean_speed(manoeuvre: str) -> float:
        made = DrivePlan(manoeuvre, 60.0, 20, 2)  # type: ignore[arg-type]
        return float(simulate(Car(), made.pilot(), seconds=60.0, rate_hz=20).true_speed.mean())

    assert mean_speed("stop_and_go") < 10 < mean_speed("cruise")


def test_drive_is_repeatable_and_checked() -> None:
    made = DrivePlan("following", 60.0, 20, 7)
    one, two = (simulate(Car(), made.pilot(), seconds=60.0, rate_hz=20).command for _ in range(2))
    np.testing.assert_array_equal(one, two)
    with pytest.raises(InputError, match="manoeuvre"):
        DrivePlan("drift", 60.0, 20, 7)  # type: ignore[arg-type]
    drawn = draw_drive(np.random.default_rng(0), seconds=60.0, manoeuvre="steps")
    assert (drawn.seconds, drawn.manoeuvre) == (60.0, "steps")


@pytest.mark.parametrize("manoeuvre", ["cruise", "steps"])
def test_a_drive_with_stops_stands_and_goes_on(manoeuvre: str, fresh_seed: int) -> None:
    plan = DrivePlan(manoeuvre, 120.0, 20, fresh_seed % 2**31, stops=True)  # type: ignore[arg-type]
    run = simulate(Car(), plan.pilot(), seconds=120.0, rate_hz=20, seed=1)
    still = run.true_speed < 0.1
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    assert len(edges) == 2  # one stop
    assert 2.0 <= (edges[1] - edges[0]) / 20 < 9.0  # drawn up to 6 s, and what the car needs to stop and start
    assert run.true_speed[-1] > 1.0
    assert run.true_speed.max() < 42
    assert run.command.min() >= ACCEL_MIN_MPS2 - 0.2
    assert np.mean(~still) > 0.5


def test_every_other_drive_without_a_standstill_gets_one() -> None:
    plans = [with_stops(DrivePlan(m, 60.0, 20, seed)) for m in MANOEUVRES for seed in (4, 5)]  # type: ignore[arg-type]
    assert {p.manoeuvre for p in plans if p.stops} == {"cruise", "steps"}
    assert all(p.seed == 4 for p in plans if p.stops)
    assert not with_stops(DrivePlan("cruise", 20.0, 20, 4)).stops  # too short
