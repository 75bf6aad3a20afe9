"""Logs of a car with noise of a usual kind: forces that wander, and white sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap import GapPlant, SimulatorInput, plant
from avtorch.io import Log

BOTH = ("accel", "speed")


@dataclass(frozen=True)
class Noise:
    """Two Ornstein-Uhlenbeck forces, jerk noise behind the lag and a gust, by size [m/s²] and time [s]; `accel_sd`
    [m/s²] and `speed_sd` [m/s] of white sensors."""

    process_sd: float = 0.05
    process_time: float = 0.35
    force_sd: float = 0.01
    force_time: float = 3.0
    accel_sd: float = 0.05
    speed_sd: float = 0.02


QUIET = Noise(force_sd=0.005)


def command_over(time: FloatArray) -> FloatArray:
    """[m/s²] a demand with steps and two sines, of mean near 0."""
    steps = np.array([0.7, -0.6, 0.3, -0.4])[(time / 3.5).astype(int) % 4]
    return steps + 0.5 * np.sin(0.9 * time) + 0.3 * np.sin(2.7 * time + 1)


def log_of(
    car: GapPlant | None = None,
    *,
    seconds: float = 60.0,
    rate_hz: int = 20,
    noise: Noise | None = QUIET,
    rng: np.random.Generator | None = None,
    channels: Sequence[str] = BOTH,
    speed0: float = 18.0,
    name: str = "drive",
) -> Log:
    """A drive of `car` under `command_over`, with errors drawn from `noise` (None: none), rows at `rate_hz`."""
    time = np.arange(round(seconds * rate_hz)) / rate_hz
    command = command_over(time)
    rough = speed0 + np.concatenate([[0.0], np.cumsum(command)[:-1] / rate_hz])
    car = plant() if car is None else car
    # effects that depend on speed use the car's own
    for _ in range(3):
        response = car.response(
            SimulatorInput(torch.as_tensor(time), torch.as_tensor(command), torch.as_tensor(rough), 0.0)
        )
        rough = response.speed.numpy()
    accel, speed = response.accel_measured.numpy().copy(), response.speed.numpy().copy()
    if noise is not None:
        drawn = drawn_errors(noise, len(time), 1 / rate_hz, np.random.default_rng(0) if rng is None else rng)
        accel, speed = accel + drawn[0], speed + drawn[1]
    given = {"accel": accel, "speed": speed}
    return Log.from_arrays(name=name, time=time, accel_cmd=command, **{w: given[w] for w in channels})


def drawn_errors(noise: Noise, rows: int, dt: float, rng: np.random.Generator) -> FloatArray:
    """Errors (2, rows) of acceleration and speed, the Ornstein-Uhlenbeck processes and their integrals exact."""
    p, w = np.zeros(rows), np.zeros(rows)
    for sd, lag in ((noise.process_sd, noise.process_time), (noise.force_sd, noise.force_time)):
        moved, gained = ornstein(sd, lag, rows, dt, rng)
        p, w = p + moved, w + gained
    return np.stack([p + noise.accel_sd * rng.standard_normal(rows), w + noise.speed_sd * rng.standard_normal(rows)])


def ornstein(sd: float, lag: float, rows: int, dt: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A stationary Ornstein-Uhlenbeck process at rows `dt` apart, and its integral from the first row."""
    one = covariance(sd, lag, np.array([0.0, dt]))  # p0, p1, w0, w1
    root = np.linalg.cholesky(one[np.ix_([0, 1, 3], [0, 1, 3])] + 1e-18 * np.eye(3))
    keep, share = root[1, 0] / root[0, 0], root[2, 0] / root[0, 0]
    draws = rng.standard_normal((rows, 2))
    p, w = np.empty(rows), np.zeros(rows)
    p[0] = sd * rng.standard_normal()
    for k in range(1, rows):
        p[k] = keep * p[k - 1] + root[1, 1] * draws[k, 0]
        w[k] = w[k - 1] + share * p[k - 1] + root[2, 1] * draws[k, 0] + root[2, 2] * draws[k, 1]
    return p, w


def covariance(sd: float, lag: float, time: FloatArray) -> FloatArray:
    """Of a stationary Ornstein-Uhlenbeck process at `time` and of its integral from 0: (2 time, 2 time)."""
    t, s = time[:, None], time[None]
    between = np.exp(-np.abs(t - s) / lag)
    mixed = np.where(  # process at t, integral to s
        t >= s,
        np.exp(-np.maximum(t - s, 0) / lag) - np.exp(-t / lag),
        2 - np.exp(-t / lag) - np.exp(-np.maximum(s - t, 0) / lag),
    )
    both = 2 * lag * np.minimum(t, s) - lag**2 * (1 - np.exp(-t / lag) - np.exp(-s / lag) + between)
    return sd**2 * np.block([[between, lag * mixed], [lag * mixed.T, both]])
