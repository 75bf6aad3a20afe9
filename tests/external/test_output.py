"""The simulator by its output: what it is, on which clock, what it lacks, and which of its parameters are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch import ExternalSimulator, InputError, diagnose
from avtorch.external.driving import aligned
from avtorch.external.external_simulator import discrepancy, less
from avtorch.external.surrogate import Surrogate, surrogate_of
from avtorch.io import Log
from tests.external.cars import OWN, drive


@pytest.fixture(scope="module")
def as_it_is() -> tuple[Log, Log]:
    return drive(11)


@pytest.fixture(scope="module")
def surrogate(as_it_is: tuple[Log, Log]) -> Surrogate:
    return surrogate_of([as_it_is[1]])


@pytest.mark.slow
def test_the_surrogate_is_what_the_simulator_is_made_of(surrogate: Surrogate) -> None:
    """It has its own four effects and no other; sizes to a few per cent, as its equations are those of another hand."""
    found = surrogate
    report = {name: {k: float(x) for k, x in values.items()} for name, values in found.plant.report().items()}
    assert set(report) == set(OWN)
    actuator, own = report["second_order_actuator"], OWN["second_order_actuator"]
    assert actuator["natural_frequency_radps"] == pytest.approx(own["natural_frequency_radps"], rel=0.05)
    assert actuator["damping_ratio"] == pytest.approx(own["damping_ratio"], rel=0.05)
    assert report["dead_time"]["delay_s"] == pytest.approx(OWN["dead_time"]["delay_s"], abs=0.01)
    assert report["aerodynamic_drag"]["drag_per_m"] == pytest.approx(OWN["aerodynamic_drag"]["drag_per_m"], rel=0.05)
    assert max(found.left.values()) < 0.005


def test_the_discrepancy_is_what_the_surrogate_leaves(as_it_is: tuple[Log, Log], surrogate: Surrogate) -> None:
    """Less its discrepancy the simulator's own output is its surrogate's, to rounding."""
    _, simulated = as_it_is
    freed = less(simulated, simulated, discrepancy(simulated, surrogate.plant))
    rest = discrepancy(replace(freed, speed=simulated.speed), surrogate.plant)
    assert np.abs(rest["accel"]).max() < 1e-9


def test_clocks_are_brought_together_by_the_commands(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    late = replace(simulated, time=simulated.time + 12.345)
    found, offset_s = aligned(late, car)
    assert offset_s == pytest.approx(12.345, abs=0.02)  # a command is held for that long
    assert found.rows == car.rows
    inside = found.engaged
    assert np.abs(found.accel - simulated.accel)[inside].max() < 0.1  # steps of 1 m/s², and a clock 5 ms off
    assert aligned(simulated, car)[1] == 0.0


def test_another_rate_is_interpolated(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    thin = simulated[slice(0, simulated.rows, 2)]
    found, _ = aligned(replace(thin, accel_cmd=None), car)
    assert np.abs(found.speed - simulated.speed)[:-2].max() < 2e-3


def test_commands_of_another_drive_are_refused(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    other = replace(simulated, accel_cmd=simulated.accel_cmd[::-1].copy())
    with pytest.raises(InputError, match=r"simulator\.csv: its accel_cmd differs from that of car\.csv by"):
        ExternalSimulator(other).beside([car])


def test_an_output_of_another_time_is_refused(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    short = simulated[slice(0, 1000)]
    with pytest.raises(InputError, match=r"simulator\.csv: covers 22% of the rows of car\.csv"):
        ExternalSimulator(short).beside([car])


def test_as_many_outputs_as_drives(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    with pytest.raises(InputError, match="found 1 logs for 2 drives"):
        ExternalSimulator(simulated).beside([car, car])


FEW = ["dead_time", "constant_resistance", "sensor_bias", "second_order_actuator", "dead_band"]


@pytest.mark.slow
def test_a_missing_effect_is_named() -> None:
    car, simulated = drive(12, more={"sensor_bias": {"bias_mps2": 0.2}})
    found = diagnose(car, baseline=ExternalSimulator(simulated), effects=FEW, pairs=False, posterior="laplace")
    assert found.verdict.names == ("sensor_bias",)
    assert found.tested is not None
    assert found.tested.missing == ("sensor_bias",)
    assert not found.tested.wrong
    size = found.winner.parameters["bias_mps2"]
    assert abs(size.mean - 0.2) < 5 * size.sd + 0.01  # its accelerometer is that of another vehicle
    assert found.to_dict()["simulator"]["missing"] == ["sensor_bias"]
    assert "Of the simulator itself (simulator.csv)" in str(found)


@pytest.mark.slow
def test_a_wrong_parameter_is_no_missing_effect() -> None:
    car, simulated = drive(13, changed={"dead_time": {"delay_s": 0.4}})
    found = diagnose(car, baseline=ExternalSimulator(simulated), effects=FEW, pairs=False, posterior="laplace")
    assert found.tested is not None
    assert found.verdict.names == ("dead_time",)
    assert found.tested.missing == ()
    wrong = {p.name: p for p in found.tested.wrong}
    delay = wrong["dead_time.delay_s"]
    assert delay.simulator == pytest.approx(0.12, abs=0.01)
    assert abs(delay.car.mean - 0.4) < 5 * delay.car.sd + 0.01
    assert str(found).startswith("A parameter of the simulator is wrong")


@pytest.mark.slow
def test_the_right_simulator_lacks_nothing(as_it_is: tuple[Log, Log]) -> None:
    car, simulated = as_it_is
    found = diagnose(car, baseline=ExternalSimulator(simulated), effects=FEW, pairs=False, posterior="laplace")
    assert found.verdict.names == ("none",)
    assert found.tested is not None
    assert not found.tested.wrong
    assert found.tested.missing == ()


@pytest.mark.slow
def test_a_standstill_is_no_gap() -> None:
    """At rest a car stays at rest, which no effect does: there nothing counts, and nothing is carried over from there.

    The car's noise sets it 0.2 m/s from its simulator in a drive, and the surrogate a few hundredths from that.
    """
    car, simulated = drive(11, manoeuvre="stop_and_go", seconds=60.0)
    assert not car.moving.all()
    beside = ExternalSimulator(simulated).beside([car])
    known = car.speed - beside.logs[0].speed
    assert np.abs(known[beside.logs[0].usable]).max() < 0.1
    assert max(beside.surrogate.left.values()) < 0.02
