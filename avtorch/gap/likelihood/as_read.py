"""A log without sensor noise, read as a sensor would have read it.

The diagnosis takes every sensor to be noisy, and what it weighs are misfits in units of that noise. In a log straight
from a simulator there is none: the least rounding is then told apart from nothing with certainty, and named. Noise as
small as a good sensor's is added to such a log, the same in every run.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avtorch.io import Log

Float = NDArray[np.float64]

FINER = 4e-4
"""Less scatter from row to row than this [m/s², m/s] is no sensor's: rounding to three decimals leaves 3e-4."""
NOISE = {"accel": 0.01, "speed": 0.005}
"""What is added, standard deviations [m/s², m/s]: a fifth and a quarter of what is typical (`noise_fit.PRIORS`)."""
_SEED = 20


def as_read(log: Log) -> tuple[Log, str | None]:
    """`log` with sensor noise, and a sentence on it; `log` itself and None where some witness has noise of its own.

    Noise is told by third differences, which motion hardly has: their median over that of unit white noise.
    """
    witnesses = {name: getattr(log, name) for name in NOISE if getattr(log, name) is not None}
    if not witnesses or any(_scatter(log, x) >= FINER for x in witnesses.values()):
        return log, None
    rng = np.random.default_rng(_SEED)
    noisy = {name: x + NOISE[name] * rng.standard_normal(len(x)) for name, x in witnesses.items()}
    told = " and ".join(
        f"{NOISE[name]:g} {unit}" for name, unit in (("accel", "m/s²"), ("speed", "m/s")) if name in noisy
    )
    named = " and ".join(noisy)
    return replace(log, **noisy), f"No sensor noise in {named}, as if simulated: noise of {told} is added to be judged."


def _scatter(log: Log, signal: Float) -> float:
    """SD of white noise that would bend `signal` from row to row as much as it is bent."""
    bends = [np.abs(np.diff(signal[part], n=3)) for part in log.segments()]
    together = np.concatenate(bends)
    # the median of a normal's absolute value, and the norm of (1, -3, 3, -1)
    return float(np.median(together)) / 0.6745 / np.sqrt(20.0) if len(together) else np.inf
