"""The car of a case: its GLVD parameters and its noise; without effects it is the whole reference vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avtorch.errors import InputError

STEP_S = 1e-3
"""Step of the reference vehicle's integrator [s]."""


@dataclass(frozen=True)
class Car:
    """`T_L` [s], `K_L` [-]; standard deviations of the noise.

    `process_sd` [m/s²]: standard deviation of the acceleration that white jerk noise causes after the actuation lag (an
    Ornstein-Uhlenbeck process of time constant `T_L`). `accel_sd` [m/s²], `speed_sd` [m/s]: white sensor noise, one
    draw per row. `speed_quantum` [m/s]: resolution of the speed signal (0: no rounding). Raises `InputError` for
    negative values and for a lag of zero.

    Example:
        >>> from benchmarks.blindtest import Car
        >>> car = Car(T_L=0.5, accel_sd=0.05)
        >>> car.silent().accel_sd, car.silent().T_L
        (0.0, 0.5)
    """

    T_L: float = 0.4
    K_L: float = 1.0
    process_sd: float = 0.03
    accel_sd: float = 0.05
    speed_sd: float = 0.02
    speed_quantum: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0 <= value < float("inf") or (name == "T_L" and value == 0):
                raise InputError(f"{name}: found {value!r}, needs a finite number {'>' if name == 'T_L' else '>='} 0")

    def silent(self) -> Car:
        """The same car without noise."""
        return Car(self.T_L, self.K_L, 0.0, 0.0, 0.0, 0.0)


def draw_car(rng: np.random.Generator) -> Car:
    """A car of ordinary actuation: lag 0.15 to 0.9 s, gain 0.8 to 1.1, noise of production sensors.

    Example:
        >>> import numpy as np
        >>> from benchmarks.blindtest import draw_car
        >>> car = draw_car(np.random.default_rng(0))
        >>> 0.15 <= car.T_L <= 0.9, 0.8 <= car.K_L <= 1.1
        (True, True)
    """

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    return Car(
        T_L=between(0.15, 0.9),
        K_L=float(rng.uniform(0.8, 1.1)),
        process_sd=between(0.03, 0.12),
        accel_sd=between(0.03, 0.12),
        speed_sd=between(0.01, 0.06),
        speed_quantum=float(rng.choice([0.0, 0.01, 0.02])),
    )
