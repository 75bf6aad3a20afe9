"""The simulator itself: driven along a log, with its faults told, and with what it lacks put around it."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from avtorch import ExternalSimulator, GLVDPlant, InputError, diagnose
from avtorch.external import check_simulator, driving, load_simulator, wrap
from avtorch.external.driving import driven_along, drives_of
from avtorch.external.external_simulator import discrepancy
from avtorch.external.surrogate import surrogate_of
from avtorch.gap import DeadTime, plant
from avtorch.io import Log


class OdeCar:
    """A lag of 0.35 s and a drag, integrated by SciPy."""

    drag = 5e-4

    def reset(self, *, speed: float, accel: float) -> None:
        self.state = np.array([accel + self.drag * speed**2, speed])

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        def slope(_: float, x: Any) -> list[float]:
            return [(accel_cmd - x[0]) / 0.35, x[0] - self.drag * x[1] ** 2]

        self.state = solve_ivp(slope, (0.0, dt), self.state, rtol=1e-6, atol=1e-8).y[:, -1]
        return self.state[0] - self.drag * self.state[1] ** 2, self.state[1]


def lap(rows: int = 400, **more: Any) -> Log:
    time = 0.05 * np.arange(rows)
    command = 0.8 * np.sin(0.9 * time) + 0.5 * np.sin(2.1 * time)
    return Log.from_arrays(
        **({"time": time, "accel_cmd": command, "accel": np.zeros(rows), "speed": np.full(rows, 20.0)} | more)
    )


def test_it_is_driven_by_the_logs_commands() -> None:
    """A Runge-Kutta solution beside one whole integration of the same equations."""
    log = lap()
    found = driven_along(OdeCar(), log)

    def slope(t: float, x: Any) -> list[float]:
        u = log.accel_cmd[min(int(t / 0.05 + 1e-9), log.rows - 1)]
        return [(u - x[0]) / 0.35, x[0] - 5e-4 * x[1] ** 2]

    whole = solve_ivp(slope, (0.0, log.time[-1]), [5e-4 * 400, 20.0], t_eval=log.time, max_step=0.01, rtol=1e-8)
    assert np.abs(found.speed - whole.y[1]).max() < 1e-3


def test_it_begins_anew_where_the_car_does() -> None:
    speed = np.full(400, 20.0)
    speed[100:120] = 0.0
    engaged = np.ones(400)
    engaged[200:240] = 0
    parts = drives_of(lap(speed=speed, engaged=engaged))
    assert [(p.start, p.stop) for p in parts] == [(0, 119), (119, 200), (240, 400)]  # from the last row at standstill


@pytest.mark.slow
def test_what_it_leaves_starts_anew_with_it() -> None:
    """A stop and an override, under which the car's speed goes its own way: no offset of speed is left behind them."""
    time = 0.05 * np.arange(2400)
    command = 0.6 * np.sin(0.9 * time) + 0.4 * np.sin(2.1 * time) + 0.2
    engaged, speed = np.ones(2400), np.full(2400, 20.0)
    engaged[800:900] = 0
    speed[800:] = 14.0  # the driver brakes
    speed[1600:1700] = 0.0
    log = Log.from_arrays(time=time, accel_cmd=command, accel=np.zeros(2400), speed=speed, engaged=engaged)
    output = driven_along(OdeCar(), log)
    surrogate = surrogate_of([output])
    known = discrepancy(output, surrogate.plant)
    # a hundredth of the speed that the simulator gains and loses by itself
    assert np.abs(known["speed"]).max() < 0.01 * np.ptp(output.speed[:800])
    assert max(surrogate.left.values()) < 0.005


def test_its_own_step() -> None:
    steps: list[float] = []

    class Counting(OdeCar):
        def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
            steps.append(dt)
            return super().step(accel_cmd, dt)

    driven_along(Counting(), lap(20), step_s=0.01)
    assert set(steps) == {0.01}
    assert len(steps) == 19 * 5


def raising(*_: Any) -> tuple[float, float]:
    raise ZeroDivisionError("no torque")


def sleeping(*_: Any) -> tuple[float, float]:
    clock.sleep(5)
    return 0.0, 0.0


FAULTS: list[tuple[Callable[..., Any], str]] = [
    (raising, "at 0.5 s of the log step raised ZeroDivisionError: 'no torque'"),
    (sleeping, "at 0.5 s of the log step took more than 0.2 s"),
    (lambda *_: (np.nan, 1.0), r"at 0.5 s of the log step returned \(nan, 1.0\), needs finite numbers"),
    (lambda *_: 3.0, r"at 0.5 s of the log step returned '3.0', needs \(accel, speed\)"),
    (lambda *_: None, r"at 0.5 s of the log step returned 'None', needs \(accel, speed\)"),
]


@pytest.mark.parametrize(("fault", "told"), FAULTS, ids=lambda x: "" if isinstance(x, str) else None)
def test_faults_are_told_with_their_time(fault: Callable[..., Any], told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(driving, "LIMIT_S", 0.2)

    class Faulty(OdeCar):
        count = 0

        def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
            self.count += 1
            return fault(accel_cmd, dt) if self.count > 10 else super().step(accel_cmd, dt)

    with pytest.raises(InputError, match=told):
        driven_along(Faulty(), lap(), name="mine")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("car", "found 'car', needs MODULE:NAME"),
        ("no_such_module:Car", "no_such_module could not be imported; ModuleNotFoundError"),
        ("math:nothing", "math has no nothing"),
        ("math:pi", "math:pi has no reset and step"),
        ("nowhere/car.py:Car", r"nowhere/car.py: no such file"),
    ],
)
def test_what_is_no_simulator_is_refused(text: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        load_simulator(text)


def test_an_object_without_step_is_refused() -> None:
    class Half:
        def reset(self, *, speed: float, accel: float) -> None: ...

    with pytest.raises(InputError, match="'Half' has no step; needs reset"):
        ExternalSimulator(Half())  # type: ignore[arg-type]


def test_a_simulator_is_what_it_is() -> None:
    """Lag, gain and drag of an ODE that is not avtorch's, from the manoeuvres."""
    found = check_simulator(OdeCar())
    assert found.values["T_L"] == pytest.approx(0.35, rel=0.02)
    assert found.values["K_L"] == pytest.approx(1.0, rel=0.01)
    assert found.values["aerodynamic_drag.drag_per_m"] == pytest.approx(5e-4, rel=0.05)
    assert found.left < 0.005


@pytest.mark.slow
def test_what_it_lacks_goes_around_it() -> None:
    """Wrapped it does what the answer's own rollout does, and is nearer to the car than as it was."""

    class Braked(OdeCar):
        def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
            accel, speed = super().step(accel_cmd - 0.3, dt)
            return accel, speed

    rng = np.random.default_rng(4)
    commands = lap(1400, accel=None)
    commands = replace(commands, accel_cmd=commands.accel_cmd + 0.45)  # against both resistances
    car = driven_along(Braked(), commands, name="car")
    noisy = Log.from_arrays(
        time=car.time,
        accel_cmd=car.accel_cmd,
        accel=car.accel + 0.05 * rng.standard_normal(car.rows),
        speed=car.speed + 0.02 * rng.standard_normal(car.rows),
    )
    few = ["constant_resistance", "sensor_bias", "dead_time"]
    found = diagnose(noisy, baseline=ExternalSimulator(OdeCar), effects=few, pairs=False, posterior="laplace")
    assert found.verdict.names == ("constant_resistance",)
    as_it_was, better = (driven_along(x, noisy) for x in (OdeCar(), wrap(OdeCar(), found)))
    before, after = (np.sqrt(np.mean((x.speed - car.speed)[200:] ** 2)) for x in (as_it_was, better))
    assert after < 0.1 * before


def test_an_attribute_called_drive_is_the_simulators_own() -> None:
    class Driven(OdeCar):
        drive = 1.0

    assert driven_along(Driven(), lap(20)).rows == 20


@pytest.mark.parametrize("own", [plant([DeadTime(0.2)]), GLVDPlant(0.3, 1.0)])
def test_a_plant_of_avtorchs_own_is_a_baseline_itself(own: object) -> None:
    with pytest.raises(InputError, match="a plant of avtorch's own, which is a baseline itself: pass baseline="):
        ExternalSimulator(own)  # type: ignore[arg-type]
