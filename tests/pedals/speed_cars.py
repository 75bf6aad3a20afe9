"""A car whose interface takes a speed: a known controller inside, by its own difference equation."""

from __future__ import annotations

import numpy as np

from avtorch.io import Log

LAG_S, DELAY_S, DT, GAIN, PUSH, BRAKE, FORWARD = 0.4, 0.1, 0.05, 0.9, 1.5, 2.5, 0.5


def demanded(error: np.ndarray, speed: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """0.9 1/s of what is missing, within what the motor and the brake may do, half the command's slope, and drag."""
    return np.clip(GAIN * error, -BRAKE, PUSH) + FORWARD * rate - 0.1 - 0.01 * speed


def wished(time: np.ndarray, rng: np.random.Generator, *, steps: bool) -> np.ndarray:
    """A speed that moves about 12 m/s, smoothly, or from one set speed to the next."""
    if steps:
        levels = 12.0 + rng.uniform(-4.0, 4.0, int(time[-1] / 8.0) + 1)
        return levels[(time / 8.0).astype(int)]
    waves = zip((0.02, 0.047, 0.11, 0.23), (2.5, 1.5, 0.8, 0.35), rng.uniform(0, 6, 4), strict=True)
    return 12.0 + sum(size * np.sin(2 * np.pi * f * time + p) for f, size, p in waves)


def drive(
    seed: int, seconds: float = 240.0, *, noise: float = 0.03, force: float = 0.1, steps: bool = False,
    integral: float = 0.0,
) -> Log:  # fmt: skip
    """A log of speed and its command; `force` [m/s²]: of wind and road, which the controller answers; `integral`
    [1/s²]: a part of it that the map cannot hold."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(round(seconds / DT))
    wish = wished(time, rng, steps=steps)
    rate = np.zeros(len(time)) if steps else np.gradient(wish, DT)
    kept = 1 - DT / 3  # slow: a time constant of three seconds
    wind = np.zeros(len(time))
    for i in range(1, len(time)):
        wind[i] = wind[i - 1] * kept + force * np.sqrt(2 * DT / 3) * rng.standard_normal()
    speed, demands = np.empty(len(time)), np.empty(len(time))
    v, a, summed, late = wish[0], 0.0, 0.0, round(DELAY_S / DT)
    for i in range(len(time)):
        seen = v + noise * rng.standard_normal()  # the log holds what the controller sees
        speed[i] = seen
        summed += integral * DT * (wish[i] - seen)
        demands[i] = demanded(wish[i] - seen, seen, rate[i]) + summed
        m = demands[max(i - late, 0)]
        v = max(v + DT * (a + wind[i]), 0.0)
        a += DT / LAG_S * (m - a)
    return Log.from_arrays(time=time, speed=np.maximum(speed, 0.0), speed_cmd=wish)
