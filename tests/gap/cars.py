"""Drives with commands of several kinds: a car with some effects, coloured noise on what is read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.signal import lfilter

from avtorch.arrays import FloatArray
from avtorch.gap import Effect, SimulatorInput, plant
from avtorch.io import Log

DT = 0.05


def command(seconds: float, rng: np.random.Generator, *, dt: float = DT) -> FloatArray:
    """Steps every few seconds with slow and quick parts (row,) [m/s²], without what lasts."""
    rows = round(seconds / dt)
    steps = np.repeat(rng.normal(0.0, 0.7, rows), rng.integers(round(1 / dt), round(5 / dt), rows))[:rows]
    slow = lfilter([1.0], [1.0, -np.exp(-dt / 4.0)], rng.normal(0.0, 0.5 * np.sqrt(2 * dt / 4.0), rows))
    u = steps + np.asarray(slow)
    share = 1 - np.exp(-dt / 8.0)  # what lasts longer would carry the speed away
    return u - np.asarray(lfilter([share], [1.0, share - 1.0], u))


def log_of(
    effects: Sequence[Effect] = (),
    *,
    seconds: float = 150.0,
    seed: int = 0,
    noise: float = 1.0,
    T_L: float = 0.35,
    K_L: float = 0.95,
    dt: float = DT,
) -> Log:
    """A car with `effects`, read by sensors whose noise is coloured, vibrates and is rounded; `noise` scales it."""
    rng = np.random.default_rng(seed)
    u = command(seconds, rng, dt=dt)
    time = np.arange(len(u)) * dt
    speed = torch.full((len(u),), 18.0, dtype=torch.float64)
    car = plant(effects, T_L=T_L, K_L=K_L)
    for _ in range(10):  # speed decides on some effects, and they on speed; the driver makes up for what they take
        response = car.response(SimulatorInput(torch.as_tensor(time), torch.as_tensor(u), speed, 0.0))
        u = u - float(response.accel.mean()) / K_L
        speed = response.speed - response.speed[0] + 18.0
    response = car.response(SimulatorInput(torch.as_tensor(time), torch.as_tensor(u), speed, 0.0))
    pole = np.exp(-dt / 1.5)
    force = np.asarray(lfilter([1.0], [1.0, -pole], rng.normal(0.0, 0.05 * np.sqrt(1 - pole**2), len(u))))
    ring = np.asarray(lfilter([1.0], [1.0, -1.2, 0.8], rng.normal(0.0, 0.03, len(u))))
    accel = response.accel_measured.numpy() + noise * (force + ring)
    driven = speed.numpy() + noise * (np.cumsum(force) * dt + rng.normal(0.0, 0.01, len(u)))
    if noise > 0:
        driven = np.round(driven / 0.01) * 0.01
    return Log.from_arrays(name="car", time=time, accel_cmd=u, speed=driven, accel=accel)
