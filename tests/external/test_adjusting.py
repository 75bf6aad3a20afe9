"""The user's own parameters: fitted in their own terms, with what is missing in its place, by few rollouts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.signal import lfilter

from avtorch import ExternalSimulator, InputError, Leader, diagnose, simulate
from avtorch.external.adjusting import Rollouts, adjusted
from avtorch.external.driving import driven_along
from avtorch.external.simulator import values_of, with_values
from avtorch.gap import DeadTime, plant
from avtorch.io import Log

LIMITS = {"lag": (0.05, 1.5), "mass": (1000.0, 3000.0)}
NOISE = 0.02


@dataclass
class Truck:
    """A lag, and a gain that its mass decides: it was made for 1500 kg."""

    lag: float = 0.3
    mass: float = 1500.0
    gain: float = field(init=False)

    def __post_init__(self) -> None:
        self.gain = 1500.0 / self.mass

    def reset(self, *, speed: float, accel: float) -> None:
        self.speed, self.accel = speed, accel

    def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
        before, goal = self.accel, self.gain * accel_cmd
        self.accel = goal + np.exp(-dt / self.lag) * (before - goal)
        self.speed += dt * (before + self.accel) / 2
        return self.accel, self.speed


def recorded(car: Truck, seed: int, *, seconds: float = 90.0) -> Log:
    """What `car` does, with noise in both channels."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, seconds, 0.05)
    command = 0.8 * np.sin(0.5 * time) + 0.5 * np.sin(1.3 * time + 1.0) + 0.3 * np.sin(0.11 * time)
    log = Log.from_arrays(time=time, accel_cmd=command, accel=0 * time, speed=np.full(len(time), 20.0))
    run = driven_along(car, log)
    assert run.accel is not None
    assert run.speed is not None
    accel, speed = (x + NOISE * rng.standard_normal(len(time)) for x in (run.accel, run.speed))
    return Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speed)


def fitted(log: Log, most: int = 50) -> tuple[dict[str, tuple[float, float, bool]], int]:
    """Value, SD and whether it differs, by parameter; and rollouts."""
    own = Truck()

    def drive(places: Sequence[Mapping[str, float]]) -> list[list[Log]]:
        return [[driven_along(with_values(own, values), log)] for values in places]

    rollouts = Rollouts([log], values_of(own, LIMITS), drive, most)
    _, found = adjusted(rollouts, LIMITS)
    return {p.name: (p.car.mean, p.car.sd, p.differs) for p in found}, len(rollouts)


@pytest.mark.statistical
@pytest.mark.parametrize("channel", ["both", "speed", "accel"])
def test_what_is_wrong_is_found_in_the_users_terms(channel: str, rotating_seed: int) -> None:
    log = recorded(Truck(lag=0.5, mass=1800.0), rotating_seed)
    log = {"both": log, "speed": replace(log, accel=None), "accel": replace(log, speed=None)}[channel]
    found, _ = fitted(log)
    for name, truth in (("lag", 0.5), ("mass", 1800.0)):
        value, sd, differs = found[name]
        assert differs
        # 22 blocks: Student's law of some twenty degrees of freedom is beyond six in 1 of 140,000
        assert abs(value - truth) < 6 * sd
        assert sd < 0.05 * truth


def test_what_is_right_stays() -> None:
    """Of ten drives: 2 % are meant to be accused, so two or more of ten by chance in 1.6 % of all sets of ten."""
    accused = [any(differs for _, _, differs in fitted(recorded(Truck(), seed))[0].values()) for seed in range(10)]
    assert sum(accused) < 2


def test_what_a_recorder_makes_late_is_no_wrong_lag() -> None:
    """Both channels 20 ms late, the speed behind a filter of 40 ms besides; the bar is that of cars that are right."""
    accused = []
    for seed in range(10):
        log = recorded(Truck(), seed)
        assert log.accel is not None
        assert log.speed is not None
        keep = 0.04 / (0.04 + 0.05)
        filtered = lfilter([1 - keep], [1, -keep], log.speed, zi=[keep * log.speed[0]])[0]
        accel, speed = (np.interp(log.time - 0.02, log.time, x) for x in (log.accel, filtered))
        found, _ = fitted(replace(log, accel=accel, speed=speed))
        accused.append(any(differs for _, _, differs in found.values()))
    assert sum(accused) < 2


def test_a_command_that_moves_between_rows_makes_no_lag_wrong() -> None:
    """The simulator holds it, and so is late by half a row; a wrong mass is found beside it."""
    accused, heavy = [], []
    for seed in range(10):
        log = recorded(Truck(), seed)
        car = Truck(mass=1900.0)
        car.reset(speed=20.0, accel=0.0)
        fine = np.arange(0.0, log.time[-1] + 0.045, 0.01)
        run = np.array([car.step(u, 0.01) for u in np.interp(fine, log.time, log.accel_cmd)])
        noise = NOISE * np.random.default_rng(seed).standard_normal((len(log.time), 2))
        accel, speed = (np.concatenate([[(0.0, 20.0)], run[4::5][: len(noise) - 1]]) + noise).T
        found, _ = fitted(replace(log, accel=accel, speed=speed))
        accused.append(found["lag"][2])
        heavy.append(found["mass"][2])
    assert all(heavy)
    assert sum(accused) < 2


def test_few_rollouts_are_enough_and_no_more_are_made() -> None:
    log = recorded(Truck(lag=0.9, mass=1200.0), 1)
    found, count = fitted(log)
    assert count <= 13  # four times three, and the last
    few, least = fitted(log, most=5)
    assert least <= 5
    for name, reach in (
        ("lag", 0.3),
        ("mass", 300.0),
    ):  # once linear is nearer than before, of the lag by half at least
        assert abs(few[name][0] - found[name][0]) < reach
    with pytest.raises(InputError, match="most_rollouts: found 3, needs 5 or more to adjust lag, mass"):
        ExternalSimulator(Truck, adjustable=LIMITS, most_rollouts=3)


@pytest.mark.slow
def test_a_missing_effect_is_not_taken_for_a_wrong_parameter() -> None:
    """The lag is what it was, before a dead time is named and with it in place."""
    car = plant([DeadTime(0.3)], T_L=0.3, sigma=0.05)
    log = simulate(Leader.default(start=30.0, duration=60.0, dt=0.05), plant=car).log()
    mine = ExternalSimulator(Truck, adjustable=LIMITS)
    alone = mine.beside([log]).own
    assert alone
    assert not any(p.differs for p in alone)
    found = diagnose(log, baseline=mine, effects=["dead_time", "sensor_bias"], pairs=False, posterior="laplace")
    assert found.tested is not None
    assert found.tested.missing == ("dead_time",)
    assert [p.name for p in found.tested.wrong] == []
    assert float(found.tested.surrogate.T_L) == pytest.approx(0.3, abs=0.01)


def test_a_wrong_parameter_is_no_missing_effect() -> None:
    log = recorded(Truck(mass=1900.0), 3, seconds=60.0)
    mine = ExternalSimulator(Truck, adjustable=LIMITS)
    found = diagnose(log, baseline=mine, effects=["dead_time", "sensor_bias"], pairs=False, posterior="laplace")
    assert found.tested is not None
    assert found.tested.missing == ()
    assert [p.name for p in found.tested.wrong] == ["mass"]
    assert "Parameters that differ: mass 1500, on the car 1900" in str(found)


def test_processes_change_nothing_but_the_time() -> None:
    log = recorded(Truck(lag=0.5), 5, seconds=40.0)
    one, two = (ExternalSimulator(Truck, adjustable=LIMITS, processes=count).beside([log]).own for count in (1, 2))
    assert len(one) == 2
    assert one == two
    with pytest.raises(InputError, match="processes: found 0, needs a number from 1 to 64"):
        ExternalSimulator(Truck, processes=0)


def test_a_fault_in_another_process_is_told() -> None:
    class Brittle(Truck):
        def step(self, accel_cmd: float, dt: float) -> tuple[float, float]:
            if self.lag != 0.3:
                raise ZeroDivisionError("no lag")
            return super().step(accel_cmd, dt)

    mine = ExternalSimulator(Brittle, adjustable=LIMITS, processes=2)
    with pytest.raises(InputError, match="Brittle: at 0 s of the log step raised ZeroDivisionError: 'no lag'"):
        mine.beside([recorded(Truck(), 5, seconds=40.0)])


def test_a_dataclass_is_made_anew() -> None:
    assert with_values(Truck(), {"mass": 3000.0}).gain == 0.5  # type: ignore[attr-defined]


def test_attributes_of_an_object_and_of_its_classes_are_parameters() -> None:
    class Car(Truck):
        delay_s, fast = 0.1, True

        @property
        def speed_kph(self) -> float:
            return 3.6 * self.speed  # not there before a drive

    car = Car()
    assert values_of(car, {"delay_s": (0.0, 0.5)}) == {"delay_s": 0.1}
    other = with_values(car, {"delay_s": 0.3})
    assert (other.delay_s, car.delay_s) == (0.3, 0.1)  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="found 'speed_kph', needs one of delay_s, gain, lag, mass"):
        values_of(car, {"speed_kph": (0.0, 100.0)})


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"wheel": (0.1, 1.0)}, "adjustable: found 'wheel', needs one of gain, lag, mass"),
        ({"lag": (1.0, 0.1)}, "adjustable lag: found limits 1 and 0.1, needs two finite numbers that rise"),
        ({"lag": (0.5, 1.0)}, "adjustable lag: is 0.3, needs limits that hold it, found 0.5 to 1"),
    ],
)
def test_what_cannot_be_adjusted_is_refused(limits: dict[str, tuple[float, float]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        ExternalSimulator(Truck, adjustable=limits)


def test_an_output_has_no_parameters() -> None:
    with pytest.raises(InputError, match="needs the simulator itself"):
        ExternalSimulator(recorded(Truck(), 1, seconds=20.0), adjustable=LIMITS)
