"""A speed that is commanded: the controller that follows it is found again, though its error holds wind and noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.pedals import PedalMap, PedalTable, fit_pedals, held_out, read_map, write_map
from avtorch.pedals.columns import MapColumns
from avtorch.pedals.fitting import Fitting
from avtorch.pedals.held_out import map_demand, roll_out
from avtorch.pedals.loop_fitting import roll
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
@pytest.mark.parametrize("steps", [True, pytest.param(False, marks=pytest.mark.slow)])
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
    """A regression on the measured error sees wind and noise on both sides; the rollouts do not."""
    log = drive(seed)
    pieces = PedalDrive.of(log)
    regressed = Fitting(pieces, MapColumns.for_drive(pieces), np.ones(pieces.blocks, bool)).fit(False).map
    assert log.speed is not None
    assert log.speed_cmd is not None
    true = demanded(log.speed_cmd - log.speed, log.speed, rate_of(log))
    off = [
        np.sqrt(np.mean((made.commanded(log).accel_cmd - true)[log.usable] ** 2))
        for made in (fit_pedals(log).map, regressed)
    ]
    assert off[0] < 0.1  # of wind and road
    assert off[0] < off[1]


def test_slopes_of_a_rollout_are_those_of_its_speed() -> None:
    pieces = PedalDrive.of(drive(55, seconds=60.0))
    columns, piece = MapColumns.for_drive(pieces), pieces.pieces[0]
    rng = np.random.default_rng(0)
    factors = rng.uniform(0.1, 0.4, columns.count)
    at = np.concatenate([[0.33, 0.17], factors])
    found = roll(piece, columns, factors, 0.33, 0.17, slopes=True).slopes
    for number in (0, 1, 2, columns.free, columns.free + 5, columns.count + 1):
        step = np.zeros(len(at))
        step[number] = 1e-6
        up, down = (
            roll(piece, columns, x[2:], float(x[0]), float(x[1]), slopes=False).missed for x in (at + step, at - step)
        )
        # a difference over 2e-6 of numbers of about ten is known to 1e-9, and the map is straight between its knots
        assert (down - up) / 2e-6 == pytest.approx(found[:, number], abs=1e-5)


def test_a_rollout_of_the_true_controller_is_exact() -> None:
    log = drive(56, seconds=60.0, noise=0.0, force=0.0)
    errors = roll_out(PedalDrive.of(log), map_demand(TRUE), TRUE.T_L, TRUE.dead_time)
    weak = replace(TRUE, pedals={n: replace(t, accel=0.7 * t.accel) for n, t in TRUE.pedals.items()})
    less = roll_out(PedalDrive.of(log), map_demand(weak), TRUE.T_L, TRUE.dead_time)
    # of the first block no row before tells the acceleration that it begins with
    assert np.sqrt(errors[1:]).max() < 0.1 < np.sqrt(less[1:]).max()


@pytest.mark.slow
def test_it_beats_one_constant_where_the_controller_has_limits() -> None:
    score = held_out(drive(57, seconds=80.0, steps=True))
    assert score.better_than("factor")


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


def test_a_map_of_a_loop_is_read_as_it_was_written(tmp_path: Path) -> None:
    files = write_map(TRUE, tmp_path)
    assert [file.name for file in files] == ["pedal_map.csv"]  # other tools take no such table
    back = read_map(files[0])
    assert list(back.pedals) == [ERROR, RATE]
    assert np.array_equal(back.pedals[ERROR].accel, TRUE.pedals[ERROR].accel)
    assert (back.T_L, back.dead_time) == (TRUE.T_L, TRUE.dead_time)


def test_pedals_come_first() -> None:
    log = drive(60, seconds=60.0)
    both = replace(log, throttle=0.3 + 0.1 * np.sin(log.elapsed))
    assert PedalDrive.of(both).names == ("throttle",)


def test_without_a_speed_or_without_moving_there_is_no_map() -> None:
    time = DT * np.arange(1200)
    given = {"time": time, "speed": 10 + np.sin(time)}
    with pytest.raises(InputError, match="found no speed_cmd that moves"):
        fit_pedals(Log.from_arrays(**given, speed_cmd=np.full(1200, 12.0)))
    accel = {"time": time, "accel": np.cos(time), "speed_cmd": 12 + np.sin(time)}
    with pytest.raises(InputError, match="found no speed, needs it for a map of speed_cmd"):
        fit_pedals(Log.from_arrays(**accel))
