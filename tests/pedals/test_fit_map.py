"""A known map is found again, within the errors that the fit itself states, with the lag and dead time behind it; on
blocks left out it scores better than one constant a pedal where the car has a map, and not where it has none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.pedals import PedalFit, fit_pedals
from benchmarks.pedals import RECORDINGS, read
from tests.pedals.cars import DEAD_ZONE, DELAY_S, LAG_S, drive, factors, plain, with_dead_zone, with_motor_brake

SEED = 11
QUICK = "roboracer, one mass"


@pytest.fixture(scope="module")
def plain_drive() -> tuple[Log, PedalFit]:
    log = drive(plain, SEED)
    return log, fit_pedals(log)


@pytest.mark.slow
def test_each_knot_is_within_its_own_errors(plain_drive: tuple[Log, PedalFit]) -> None:
    _, fit = plain_drive
    zero = np.zeros(1)
    for name, table in fit.map.pedals.items():
        x, v = np.meshgrid(table.pedal, fit.map.speed, indexing="ij")
        true = (plain(x, zero, v) if name == "throttle" else plain(zero, x, v)) - plain(zero, zero, v)
        assert table.sd is not None
        off = np.abs(table.accel - true)[1:] / table.sd[1:]
        # 24 blocks: beyond four standard errors one knot in two thousand, and knots go together
        assert off.max() < 4.0, (name, off.max())
        assert (table.accel[table.pedal == 0] == 0).all()


def test_how_late_the_car_is(plain_drive: tuple[Log, PedalFit]) -> None:
    _, fit = plain_drive
    off = fit.map.T_L + fit.map.dead_time - (LAG_S + DELAY_S)
    # the car's own difference equation, with its steps of 50 ms, is that continuous one to a tenth of a step
    assert abs(off) < 4 * fit.late_sd + 0.005
    assert abs(fit.map.T_L - LAG_S) < 4 * fit.T_L_sd
    assert abs(fit.map.dead_time - DELAY_S) < 4 * fit.dead_time_sd


def test_a_map_is_off_by_less_than_wind_and_road() -> None:
    log = drive(with_dead_zone, SEED, force=0.1)
    made = fit_pedals(log).map
    assert log.speed is not None
    assert log.throttle is not None
    assert log.brake is not None
    off = made.accel(log.speed, throttle=log.throttle, brake=log.brake)
    off = off - with_dead_zone(log.throttle, log.brake, log.speed)
    assert np.sqrt(np.mean(off[log.usable] ** 2)) < 0.1


@pytest.mark.slow
def test_a_dead_zone_is_found_on_a_calm_day() -> None:
    table = fit_pedals(drive(with_dead_zone, SEED, force=0.02)).map.pedals["throttle"]
    slope = np.diff(table.accel, axis=0) / np.diff(table.pedal)[:, None]
    inside, beyond = table.pedal[1:] <= DEAD_ZONE, table.pedal[:-1] >= DEAD_ZONE
    assert slope[inside].mean() < 0.5 * slope[beyond].mean()


def test_where_nothing_was_driven_resistance_goes_on_along_a_line() -> None:
    log = drive(with_motor_brake, SEED)
    assert log.speed is not None
    made = fit_pedals(log).map
    assert made.driven == pytest.approx(
        (log.speed.min(), log.speed.max()), abs=0.15
    )  # of means over a tenth of a second
    last, furthest = np.searchsorted(made.speed, made.driven[1]) - 1, len(made.speed) - 1
    assert furthest > last
    assert made.coasting_sd is not None
    fell = made.coasting[furthest] - made.coasting[last]
    true = -0.3 * (made.speed[furthest] - made.speed[last])
    error = np.hypot(*made.coasting_sd[[last, furthest]])
    assert abs(fell - true) < 4 * error
    assert abs(fell - true) < abs(true)  # nearer than a curve that is held


def test_the_fit_is_the_same_every_time(plain_drive: tuple[Log, PedalFit]) -> None:
    log, one = plain_drive
    two = fit_pedals(log)
    assert np.array_equal(one.map.pedals["brake"].accel, two.map.pedals["brake"].accel)
    assert one.map.T_L == two.map.T_L


def test_drives_of_one_car_are_fitted_together() -> None:
    one, two = drive(plain, 4, seconds=60.0), drive(plain, 5, seconds=60.0)
    driven = fit_pedals([one, two]).map.driven
    assert driven is not None
    speeds = [np.quantile(log.speed, (0.02, 0.98)) for log in (one, two)]
    assert driven[0] < min(low for low, _ in speeds)
    assert driven[1] > max(high for _, high in speeds)


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ({"speed": None, "accel": np.zeros(600)}, "found no speed"),
        ({"throttle": np.zeros(600)}, "found no pedal that moves"),
        ({"throttle": None, "accel_cmd": np.ones(600)}, "found no pedal that all of them have"),
    ],
)
def test_what_no_map_can_be_fitted_to(columns: dict, told: str) -> None:
    time = 0.05 * np.arange(600)
    given = {"time": time, "speed": 10 + np.sin(time), "throttle": 0.5 + 0.3 * np.sin(time)} | columns
    with pytest.raises(InputError, match=told):
        fit_pedals(Log.from_arrays(**given))


def test_a_short_drive_is_refused() -> None:
    with pytest.raises(InputError, match="found 2 blocks of some seconds that count, needs 3 for a map"):
        fit_pedals(drive(plain, 6, seconds=8.0))


def test_a_map_beats_one_factor_where_the_car_has_one() -> None:
    assert fit_pedals(drive(with_dead_zone, 21, seconds=100.0)).held_out.better_than("factor")


def test_a_map_is_not_said_to_beat_the_factor_that_the_car_is() -> None:
    score = fit_pedals(drive(factors, 22, seconds=100.0)).held_out
    assert not score.better_than("factor")
    # wind and road foretell nothing, and that is all that is left
    assert score.rmse("map") < 0.6


@pytest.mark.parametrize("name", [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in RECORDINGS])
def test_on_recordings_a_map_beats_one_factor(name: str, data_dir: Path) -> None:
    score = fit_pedals(read(name, data_dir)).held_out
    assert score.rmse("map") < score.rmse("factor")
