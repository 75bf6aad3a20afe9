"""An effect in front of a recorded car: the simulator with the effect answers the new command as the car did the old.

The effects of `avtorch.gap` share no code with the rewriting, so the two are compared.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from avtorch.errors import InputError
from avtorch.gap import SimulatorInput, plant
from avtorch.io import Log
from benchmarks.blindtest.in_front import IN_FRONT, put_in_front

T_L, K_L, RATE = 0.4, 0.9, 100
FORCES = ("constant_resistance", "aerodynamic_drag")
COMMANDS = ("dead_time", "dead_band", "backlash", "brake_throttle_asymmetry", "gain_change", "speed_dependent_gain")


def recorded(seconds: float = 60.0, speed0: float = 18.0) -> Log:
    """A bare GLVD car, its command smooth enough that a force's slope is the slope between two rows."""
    time = torch.arange(round(seconds * RATE), dtype=torch.float64) / RATE
    command = 0.9 * torch.sin(0.5 * time) + 0.5 * torch.sin(1.3 * time + 1.0)
    response = plant([], T_L=T_L, K_L=K_L).response(SimulatorInput(time, command, torch.full_like(time, speed0)))
    return Log.from_arrays(
        time=time.numpy(), accel_cmd=command.numpy(), accel=response.accel.numpy(), speed=response.speed.numpy()
    )


def answered(log: Log, described: str) -> np.ndarray:
    """Acceleration of the simulator with an effect, its commands settled as the recorded car's were."""
    drive = SimulatorInput(
        torch.as_tensor(log.time), torch.as_tensor(log.accel_cmd), torch.as_tensor(log.speed), log.accel[0]
    )
    car = plant([], baseline=described, T_L=T_L, K_L=K_L)
    return car.prepared(drive).response(drive).accel.numpy()


@pytest.mark.parametrize("effect", [*COMMANDS, *FORCES])
def test_the_simulator_with_the_effect_answers_as_the_car_did(effect: str) -> None:
    log = recorded()
    changed, truth = put_in_front(log, effect, T_L=T_L, K_L=K_L, seed=3)
    values = truth | ({"ramp_s": 1e-3} if effect == "gain_change" else {})
    text = ", ".join(f"{effect}.{key}={value!r}" for key, value in values.items())
    with_effect, without = answered(changed, text), answered(changed, f"{effect}={_neutral(effect)}")
    settled = slice(5 * RATE, -RATE)
    off = np.abs(with_effect - changed.accel)[settled]
    there = np.abs(without - changed.accel)[settled]
    # a force's slope is taken between rows and of a smoothed speed, a play's side where the command turns
    assert np.sqrt(np.mean(off**2)) < 0.03 * np.sqrt(np.mean(there**2))


def _neutral(effect: str) -> float:
    from avtorch.gap.simulator.effect import effect_class

    return effect_class(effect).parameters[0].neutral


@pytest.mark.parametrize("effect", IN_FRONT)
def test_the_response_stays_real(effect: str) -> None:
    log = recorded(30.0, 1.5)  # slow enough that a car creeps
    changed, truth = put_in_front(log, effect, T_L=T_L, K_L=K_L, seed=1)
    assert truth
    assert all(np.isfinite(list(truth.values())))
    kept = np.searchsorted(log.time, changed.time)
    np.testing.assert_array_equal(changed.time, log.time[kept])
    np.testing.assert_array_equal(changed.speed, log.speed[kept])
    sensor = effect.startswith("sensor") or effect == "outliers"
    same = np.array_equal(changed.accel, log.accel[kept]), np.array_equal(changed.accel_cmd, log.accel_cmd[kept])
    assert same == (not sensor, sensor)
    again, _ = put_in_front(log, effect, T_L=T_L, K_L=K_L, seed=1)
    np.testing.assert_array_equal(again.accel_cmd, changed.accel_cmd)
    np.testing.assert_array_equal(again.accel, changed.accel)


@pytest.mark.parametrize("size", [0.5, 1.25])
def test_a_limit_gives_back_the_commands_that_the_car_obeyed(size: float) -> None:
    """Forwards, the knee makes of every new command the old one; no stretch holds a row beyond the limit."""
    log = recorded()
    changed, truth = put_in_front(log, "saturation", T_L=T_L, K_L=K_L, size=size)
    limit, kept = truth["accel_max_mps2"] / K_L, np.searchsorted(log.time, changed.time)
    u, old = changed.accel_cmd, log.accel_cmd[kept]  # type: ignore[index]
    forwards = np.where(u > 0.7 * limit, limit - 0.3 * limit * np.exp(-(u - 0.7 * limit) / (0.3 * limit)), u)
    np.testing.assert_allclose(forwards, old, atol=1e-12)
    assert old.max() <= 0.99 * limit
    assert u.max() > 1.2 * limit
    share = np.mean(log.accel_cmd[log.accel_cmd > 0] > limit)  # type: ignore[index,operator]
    assert share == pytest.approx(0.2 * size, abs=0.01)  # a quantile between rows of a smooth command
    # where rows were dropped a segment ends, and none is shorter than a second
    assert [part.stop for part in changed.segments()][:-1] == (np.flatnonzero(np.diff(kept) > 1) + 1).tolist()
    assert min(part.stop - part.start for part in changed.segments()) >= RATE
    # behind a dropped row the acceleration of the limit has died away
    begins = [part.start for part in changed.segments()][1:]
    assert all(kept[b] - 1 - np.flatnonzero(log.accel_cmd[: kept[b]] > 0.99 * limit)[-1] >= T_L * RATE for b in begins)  # type: ignore[index,operator]


def test_creep_is_a_push_at_walking_speed() -> None:
    log = recorded(30.0, 1.5)
    changed, truth = put_in_front(log, "low_speed_creep", T_L=T_L, K_L=K_L)
    speed, less = np.asarray(log.speed), log.accel_cmd - changed.accel_cmd  # type: ignore[operator]
    assert (less[speed > 3.5] == 0).all()
    assert 0 < speed.min() < 2.5
    slow = speed < 2.0
    force = truth["creep_mps2"] * (1 - (speed / 3) ** 2)
    # K_L times the command that is saved, through the lag, is the force; its slope adds T_L f'
    slope = np.gradient(force, log.time)
    np.testing.assert_allclose(K_L * less[slow], (force + T_L * slope)[slow], rtol=0.1, atol=0.02)


@pytest.mark.parametrize(
    ("change", "told"),
    [({"effect": "wings"}, "effect: found 'wings'"), ({"size": 0.0}, "size: found 0"), ({"T_L": np.nan}, "T_L: found")],
)
def test_what_it_refuses(change: dict, told: str) -> None:
    arguments = {"effect": "dead_time", "T_L": T_L, "K_L": K_L} | change
    with pytest.raises(InputError, match=told):
        put_in_front(recorded(5.0), arguments.pop("effect"), **arguments)


def test_a_log_without_the_signal_is_refused() -> None:
    log = recorded(5.0)
    bare = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, accel=log.accel)
    with pytest.raises(InputError, match="has no speed"):
        put_in_front(bare, "aerodynamic_drag", T_L=T_L, K_L=K_L)
    never_pulls = Log.from_arrays(time=log.time, accel_cmd=-np.abs(log.accel_cmd), speed=log.speed)
    with pytest.raises(InputError, match="no positive command"):
        put_in_front(never_pulls, "saturation", T_L=T_L, K_L=K_L)
    blind = Log.from_arrays(time=log.time, accel_cmd=log.accel_cmd, speed=log.speed)
    with pytest.raises(InputError, match="has no accel,"):
        put_in_front(blind, "sensor_bias", T_L=T_L, K_L=K_L)


def test_on_a_recording(data_dir: Path) -> None:
    log = Log.read(data_dir / "genesis" / "lap1.csv")
    for effect in IN_FRONT:
        if effect.startswith("sensor") or effect == "outliers":
            continue
        changed, _ = put_in_front(log, effect, T_L=0.3, K_L=0.95, size=0.8)
        assert np.isfinite(changed.accel_cmd).all()
        np.testing.assert_array_equal(changed.speed, log.speed[np.isin(log.time, changed.time)])
