"""A car with a known map of throttle and brake, by its own difference equation."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from avtorch.io import Log

LAG_S, DELAY_S, DT, DEAD_ZONE = 0.4, 0.1, 0.05, 0.12


Demand = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def plain(throttle: np.ndarray, brake: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """A throttle that does less at speed, a brake of 8 m/s² at full pedal, resistance and engine braking."""
    return 6.0 * throttle * (1.0 - 0.015 * speed) - 8.0 * brake - 0.2 - 0.03 * speed


def with_dead_zone(throttle: np.ndarray, brake: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """The same beyond 12 % of throttle, with drag."""
    return plain(np.clip(throttle - DEAD_ZONE, 0, None), brake, speed) - 0.0008 * speed**2


def with_motor_brake(throttle: np.ndarray, brake: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """A motor whose current falls with its speed, as that of a small electric car does."""
    return 12.0 * throttle - 8.0 * brake - 0.3 * speed


def factors(throttle: np.ndarray, brake: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """One constant a pedal, and nothing else."""
    return 5.0 * throttle - 8.0 * brake + 0.0 * speed


def drive(demand: Demand, seed: int, seconds: float = 240.0, noise: float = 0.03, force: float = 0.1) -> Log:
    """A log of pedals alone, by a driver who keeps about 15 m/s; `force` [m/s²]: of wind and road, which nothing
    foretells."""
    rng = np.random.default_rng(seed)
    count = round(seconds / DT)
    time = DT * np.arange(count)
    wish = sum(
        np.sin(2 * np.pi * f * time + p) for f, p in zip((0.02, 0.047, 0.11, 0.23), rng.uniform(0, 6, 4), strict=True)
    )
    throttle, brake = np.zeros(count), np.zeros(count)
    wind = np.zeros(count)
    for i in range(1, count):  # slow: a time constant of three seconds
        wind[i] = wind[i - 1] * (1 - DT / 3) + force * np.sqrt(2 * DT / 3) * rng.standard_normal()
    speed, v, a, late = np.empty(count), 12.0, 0.0, round(DELAY_S / DT)
    for i in range(count):
        speed[i] = v
        pedal = 0.2 * wish[i] - 0.05 * (v - 15.0)
        throttle[i], brake[i] = np.clip(pedal, 0, 1), np.clip(-0.5 * pedal, 0, 1)
        m = float(demand(throttle[max(i - late, 0)], brake[max(i - late, 0)], np.array(v)))
        v = max(v + DT * (a + wind[i]), 0.0)
        a += DT / LAG_S * (m - a)
    return Log.from_arrays(
        time=time, throttle=throttle, brake=brake, speed=np.maximum(speed + noise * rng.standard_normal(count), 0.0)
    )
