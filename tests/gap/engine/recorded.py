"""Logs of simulated cars behind a recorder, and hypotheses fitted to them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d

from avtorch import Log
from avtorch.arrays import FloatArray
from avtorch.gap import Effect, plant
from avtorch.gap.engine.drive_data import DriveData
from avtorch.gap.engine.gauss_newton import fit
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.simulator.simulator_input import SimulatorInput

LAG, GAIN = 0.35, 0.95
LATE = {"accel": 0.012, "speed": 0.03}
FILTER = {"accel": 0.02, "speed": 0.04}
SD = {"accel": 0.05, "speed": 0.01}


def recorded_log(
    effects: Sequence[Effect] = (),
    *,
    seconds: float = 40.0,
    rate_hz: float = 20.0,
    seed: int = 0,
    drift: float = 0.0,
) -> Log:
    """A drive around 10 m/s of a car with `effects`, delayed and filtered, with white noise.

    `drift`: relative change of the gain from the first half to the second, which no effect of the car has.
    """
    random, fine = np.random.default_rng(seed), round(200 / rate_hz)
    time = np.arange(round(seconds * rate_hz) * fine) / (rate_hz * fine)
    command = sum(
        size * np.sin(2 * np.pi * hertz * time + phase)
        for size, hertz, phase in zip(
            (0.7, 0.5, 0.4, 0.3), (0.05, 0.11, 0.23, 0.4), random.uniform(0, 6, 4), strict=True
        )
    )
    command = command + np.repeat(random.normal(0, 0.5, len(time) // 200 + 1), 200)[: len(time)]
    grown = command * (1 + drift * (time > seconds / 2))
    wanted = 4 * np.sin(2 * np.pi * time / 40) - np.cumsum(GAIN * grown) * (time[1] - time[0])
    correction = np.gradient(gaussian_filter1d(wanted, 600), time) / GAIN
    command, grown = command + correction, grown + correction
    every = slice(None, None, fine)
    held, acted = (np.repeat(x[every], fine) for x in (command, grown))
    car, speed = plant(effects, T_L=LAG, K_L=GAIN), 10 + 4 * np.sin(2 * np.pi * time / 40)
    for _ in range(3):
        response = car.response(SimulatorInput(torch.as_tensor(time), torch.as_tensor(acted), torch.as_tensor(speed)))
        speed = 10 + (response.speed - response.speed[0]).numpy()
    signals = {"accel": response.accel_measured.numpy(), "speed": speed}
    rows = {
        name: _recorded(x, time, LATE[name], FILTER[name])[every] + SD[name] * random.standard_normal(len(time) // fine)
        for name, x in signals.items()
    }
    return Log.from_arrays(time=time[every], accel_cmd=held[every], **rows)


def _recorded(x: FloatArray, time: FloatArray, delay: float, time_constant: float) -> FloatArray:
    keep = np.exp(-(time[1] - time[0]) / time_constant)
    out, state = np.empty_like(x), x[0]
    for k, late in enumerate(np.interp(time - delay, time, x)):
        state = keep * state + (1 - keep) * late
        out[k] = state
    return out


def fitted_hypothesis(
    log: Log | Sequence[Log], effect: str = "", start: Sequence[float] = (), onset: float | None = None
) -> Hypothesis:
    """A fit of one effect, or of none, to a log, or to several."""
    h = Hypothesis(DriveData.of(log))
    for name in h.data.channels:
        h[f"{name}_delay"], h[f"{name}_filter"] = LATE[name], FILTER[name]
    h["T_L"], h["K_L"] = LAG, GAIN
    return fit(h.with_effect(effect, start, onset) if effect else h, 12, 0.001)
