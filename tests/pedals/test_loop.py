"""A speed that is commanded: the controller that follows it is found again, though its error holds wind and noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.gap.result.free_form import Fit, knots_of
from avtorch.io import Log
from avtorch.pedals import PedalMap, PedalTable, fit_pedals, write_map
from avtorch.pedals.fit_map import car_of
from avtorch.pedals.pedal_drive import PedalDrive
from avtorch.pedals.pedal_map import ERROR, RATE, SIGN, rate_of
from tests.pedals.speed_cars import BRAKE, DELAY_S, DT, FORWARD, GAIN, LAG_S, PUSH, demanded, drive

# what the car's difference equation is in continuous time: its lag forgets as this one does, and it acts a step later
EULER_LAG_S = DT / -np.log1p(-DT / LAG_S)
TRUE = PedalMap(
    np.array([0.0, 60.0]),
    np.array([-0.1, -0.7]),
    {
        ERROR: PedalTable(
            np.array([-20.0, -BRAKE / GAIN, 0.0, PUSH / GAIN, 20.0]),
            np.array([[-BRAKE] * 2, [-BRAKE] * 2, [0.0] * 2, [PUSH] * 2, [PUSH] * 2]),
        ),
        RATE: PedalTable(np.array([-9.0, 0.0, 9.0]), FORWARD * np.array([[-9.0] * 2, [0.0] * 2, [9.0] * 2])),
    },
    T_L=EULER_LAG_S,
    dead_time=DELAY_S + DT / 2,
)


@pytest.mark.parametrize("seed", [51, pytest.param(52, marks=pytest.mark.slow)])
@pytest.mark.parametrize("steps", [True, False])
def test_a_known_controller_is_found_again(seed: int, steps: bool) -> None:
    fit = fit_pedals(drive(seed, steps=steps))
    made = fit.map
    assert set(made.pedals) == ({ERROR} if steps else {ERROR, RATE})
    middle = len(made.speed) // 2
    for name, table in made.pedals.items():
        assert table.sd is not None
        # the knot nearest to 0.7, where each drive has been
        knot = int(np.argmin(np.abs(table.pedal - 0.7) + 9.0 * (table.pedal == 0)))
        x = table.pedal[knot]
        true = FORWARD * x if name == RATE else min(GAIN * x, PUSH)
        # 24 blocks: beyond four standard errors one of six values in three hundred
        assert abs(table.accel[knot, middle] - true) < 4 * table.sd[knot, middle], name
    # between the car's equation and the continuous one lies half a step at most
    assert abs(made.T_L + made.dead_time - (LAG_S + DELAY_S)) < 4 * fit.late_sd + DT / 2
    assert abs(made.T_L - EULER_LAG_S) < 4 * fit.T_L_sd + DT / 2


@pytest.mark.parametrize("seed", [53, pytest.param(54, marks=pytest.mark.slow)])
def test_wind_does_not_weaken_the_controller(seed: int) -> None:
    """A regression on the measured error finds a third of the gain; runs that close the loop find it."""
    log = drive(seed)
    assert log.speed is not None
    assert log.speed_cmd is not None
    true = demanded(log.speed_cmd - log.speed, log.speed, rate_of(log))
    off = (fit_pedals(log).map.commanded(log).accel_cmd - true)[log.usable]
    # twice wind and road; a third of the gain would miss 0.6 of a command that moves by 0.9
    assert np.sqrt(np.mean(off**2)) < 0.2 < 0.3 * np.std(true)


def test_slopes_of_a_closed_loop_are_those_of_its_runs() -> None:
    pieces = PedalDrive.of(drive(55, seconds=60.0))
    car = car_of(pieces, 0.17, knots_of(pieces.command, pieces.speed), 0.0)
    x = car.zero + 0.3 * np.random.default_rng(0).normal(size=len(car.zero))
    x[-1] = np.log(0.33)
    slopes = Fit(car, x).slopes
    for k in range(len(x) - 1):
        step = np.zeros(len(x))
        step[k] = 1e-6
        # straight between knots, and a knot is passed by none of a thousand rows within a millionth
        difference = (Fit(car, x + step).errors - Fit(car, x - step).errors) / 2e-6
        assert slopes[:, k] == pytest.approx(difference, abs=1e-4)


@pytest.mark.slow
def test_it_beats_one_constant_where_the_controller_has_limits() -> None:
    held_out = fit_pedals(drive(57, steps=True)).held_out
    # wind leaves 0.1 m/s; one constant cannot have the limits, where a step of the speed is 3 m/s of error
    assert held_out.rmse("map") < 0.5 * held_out.rmse("factor")


def test_the_command_is_what_the_controller_demands() -> None:
    log = drive(58, seconds=20.0)
    assert log.speed is not None
    assert log.speed_cmd is not None
    command = TRUE.commanded(log).accel_cmd
    assert command == pytest.approx(demanded(log.speed_cmd - log.speed, log.speed, rate_of(log)), abs=1e-12)
    with pytest.raises(InputError, match="has no speed_cmd, which the map needs"):
        TRUE.commanded(replace(log, speed_cmd=None))


@pytest.mark.slow
def test_more_of_what_is_missed_never_slows_the_car() -> None:
    made = fit_pedals(drive(59, seconds=80.0, force=0.3)).map
    for name, table in made.pedals.items():
        assert (SIGN[name] * np.diff(table.accel, axis=0) >= 0).all()


def test_a_map_of_a_loop_has_no_table_for_other_tools(tmp_path: Path) -> None:
    assert [file.name for file in write_map(TRUE, tmp_path)] == ["pedal_map.csv"]


def test_pedals_come_first() -> None:
    log = drive(60, seconds=60.0)
    both = replace(log, throttle=0.3 + 0.1 * np.sin(log.elapsed))
    assert list(PedalDrive.of(both).pedals) == ["throttle"]


def test_without_a_speed_or_without_moving_there_is_no_map() -> None:
    time = DT * np.arange(1200)
    given = {"time": time, "speed": 10 + np.sin(time)}
    with pytest.raises(InputError, match="found no speed_cmd that moves"):
        fit_pedals(Log.from_arrays(**given, speed_cmd=np.full(1200, 12.0)))
    accel = {"time": time, "accel": np.cos(time), "speed_cmd": 12 + np.sin(time)}
    with pytest.raises(InputError, match="found no speed, needs it for a map of speed_cmd"):
        fit_pedals(Log.from_arrays(**accel))
