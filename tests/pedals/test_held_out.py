"""The score on blocks held out: a better map scores better, a worse one worse, and a needless one wins nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.pedals import PedalMap, PedalTable, crossed, fit_pedals, held_out
from avtorch.pedals.held_out import map_demand, roll_out
from avtorch.pedals.pedal_drive import PedalDrive
from tests.pedals.cars import drive, factors, plain, with_dead_zone


@pytest.mark.slow
def test_a_map_beats_one_factor_where_the_car_has_one() -> None:
    assert held_out(drive(with_dead_zone, 21, seconds=100.0)).better_than("factor")


@pytest.mark.slow
def test_a_map_is_not_said_to_beat_the_factor_that_the_car_is() -> None:
    score = held_out(drive(factors, 22, seconds=100.0))
    assert not score.better_than("factor")
    gain, error = score.gain("factor")
    assert score.gain("map", of="factor") == pytest.approx((-gain, error))


def test_a_worse_map_is_reported_as_worse() -> None:
    log = drive(plain, 23, seconds=120.0)
    pieces, fit = PedalDrive.of(log), fit_pedals(log).map
    weak = {name: PedalTable(t.pedal, 0.7 * t.accel) for name, t in fit.pedals.items()}
    errors = [
        np.sqrt(roll_out(pieces, map_demand(made), made.T_L, made.dead_time).mean())
        for made in (fit, replace(fit, pedals=weak), replace(fit, coasting=fit.coasting - 0.5))
    ]
    assert errors[0] < min(errors[1:])


def test_a_rollout_of_the_true_map_is_exact() -> None:
    """Without wind and noise what is left is the car's own steps of Euler, and the start's average."""
    log = drive(plain, 24, seconds=60.0, noise=0.0, force=0.0)
    speed = np.array([0.0, 60.0])
    throttle = PedalTable(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [6.0, 0.6]]))
    brake = PedalTable(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [-8.0, -8.0]]))
    lag = 0.05 / -np.log1p(-0.125)  # Euler's lag of 0.4 s forgets as this exact one does
    made = PedalMap(speed, np.array([-0.2, -2.0]), {"throttle": throttle, "brake": brake}, lag, 0.1)
    errors = roll_out(PedalDrive.of(log), map_demand(made), made.T_L, made.dead_time)
    # of the first block no row before tells the acceleration that it begins with
    assert np.sqrt(errors[1:]).max() < 0.1


def test_crossed_commands_are_of_maps_without_the_block() -> None:
    log = drive(with_dead_zone, 25, seconds=80.0)
    whole = fit_pedals(log).map.commanded(log).accel_cmd
    apart = crossed(log)[0].accel_cmd
    assert whole is not None
    assert apart is not None
    assert (apart[log.usable] != whole[log.usable]).mean() > 0.9
    assert np.corrcoef(apart, whole)[0, 1] > 0.95
