"""A command that repeats itself shows a delay only up to its period: all the delays that fit alike, and none of them
claimed over no delay where that fits as well."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import avtorch
from avtorch.arrays import FloatArray
from avtorch.gap import DeadTime, SimulatorInput, plant
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.search.delays import repeats_after
from avtorch.io import Log


def _command(shape: str, period: float, time: FloatArray) -> FloatArray:
    phase = (time / period + 1e-6) % 1
    return 3 * np.sin(2 * np.pi * phase) if shape == "sine" else np.where(phase < 0.5, 3.0, -3.0)


def _log(shape: str, period: float, rate: float, *, delay: float = 0.0, seconds: float = 20.0, seed: int = 1) -> Log:
    """A GLVD car behind `delay` [s], its sensors noisy."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    command = _command(shape, period, time)
    car = plant([DeadTime(delay)] if delay else [])
    speed = torch.full((len(time),), 20.0, dtype=torch.float64)
    seen = car.response(SimulatorInput(torch.as_tensor(time), torch.as_tensor(command), speed, 0.0))
    noisy = [x.numpy() + sd * rng.standard_normal(len(time)) for x, sd in ((seen.accel, 0.02), (seen.speed, 0.01))]
    return Log.from_arrays(time=time, accel_cmd=command, accel=noisy[0], speed=noisy[1])


def _euler(seconds: float = 40.0, seed: int = 1) -> Log:
    """±3 m/s² in turn at 20 Hz, the car by Euler's rule at the log's own steps, as simple simulators have it."""
    rng, dt, lag = np.random.default_rng(seed), 0.05, 0.3
    time = np.arange(round(seconds / dt)) * dt
    command = _command("square", 0.1, time)
    accel, speed = np.zeros(len(time)), np.full(len(time), 20.0)
    for k in range(len(time) - 1):
        accel[k + 1] = accel[k] + dt / lag * (command[k] - accel[k])
        speed[k + 1] = speed[k] + dt * accel[k]
    accel, speed = accel + 0.05 * rng.standard_normal(len(time)), speed + 0.02 * rng.standard_normal(len(time))
    return Log.from_arrays(time=time, accel_cmd=command, accel=accel, speed=speed)


def _diagnosed(log: Log) -> Diagnosis:
    return avtorch.diagnose(log, effects=["dead_time", "sensor_bias"])


@pytest.mark.slow
def test_alternating_commands_of_20_hz_show_no_dead_time() -> None:
    """Once called a dead time of 0.217 ± 0.002 s, or of 0.117 s, and distinguished from everything."""
    found = _diagnosed(_euler())
    assert {"none", "dead_time"} <= set(found.verdict.alias_set)
    assert found.verdict.name != "dead_time"
    delay = next(c for c in found.candidates if c.name == "dead_time").parameters["delay_s"]
    assert delay.q05 < 0.05  # within a row of none
    assert delay.q95 > 0.2
    assert "repeats every 0.1 s" in found.verdict.why
    assert any("does not repeat" in note for note in found.notes)


@pytest.mark.parametrize(
    ("shape", "period", "rate"),
    [
        ("square", 0.1, 40),
        ("sine", 2.0, 20),
        *(
            pytest.param(*more, marks=pytest.mark.slow)
            for more in (("square", 0.1, 100), ("square", 0.4, 50), ("sine", 0.25, 40))
        ),
    ],
)
def test_a_multiple_of_the_period_is_no_delay(shape: str, period: float, rate: float) -> None:
    """No dead time is there; one of a period, or under a sine one with less lag, does the same."""
    found = _diagnosed(_log(shape, period, rate))
    assert found.verdict.name in ("none", "unknown")
    assert found.probability("dead_time") < 0.05
    if found.verdict.name == "none":
        assert "dead_time" in found.verdict.alias_set
        assert "explains this log as well" not in str(found)


@pytest.mark.slow
def test_at_200_hz_too() -> None:
    found = _diagnosed(_log("square", 0.1, 200, seconds=14.0))
    assert found.verdict.name == "none"
    assert "dead_time" in found.verdict.alias_set


@pytest.mark.slow
def test_a_delay_within_the_period_is_known_up_to_the_period() -> None:
    """0.24 s under a command of 0.4 s: a dead time it is, of 0.24 or 0.64 s."""
    found = _diagnosed(_log("square", 0.4, 20, delay=0.24))
    assert found.verdict.name == "dead_time"
    assert "none" not in found.verdict.alias_set
    delay = found.winner.parameters["delay_s"]
    assert delay.q05 == pytest.approx(0.24, abs=0.02)
    assert delay.q95 == pytest.approx(0.64, abs=0.02)
    assert any("0.24" in note and "0.64" in note for note in found.notes)


def test_periods() -> None:
    def after(command: FloatArray, dt: float) -> float | None:
        time = torch.arange(len(command), dtype=torch.float64) * dt
        return repeats_after([SimulatorInput(time, torch.as_tensor(command))])

    time = np.arange(2000) * 0.01
    for shape in ("square", "sine"):
        for period in (0.1, 0.25, 3.0):
            assert after(_command(shape, period, time), 0.01) == pytest.approx(period, abs=0.011)
    assert after(np.ones(100), 0.05) is None
    assert after(np.random.default_rng(0).standard_normal(4000).cumsum(), 0.01) is None
    assert after(np.repeat(np.random.default_rng(1).uniform(-1.5, 1.5, 100), 10), 0.05) is None
