"""The noise of a rollout's errors: a linear-Gaussian model with six parameters.

The error of a rollout is the part of the measurement that no deterministic response predicts,

    dw/dt = p + d            error of the speed
    p: white jerk noise through the actuator's lag, an Ornstein-Uhlenbeck process (sd, time constant)
    d: a slow coloured force (sd, time constant): a nuisance in every hypothesis, the cause where that is a random force
    accel measured = p + d + white,   speed measured = w + white

A user's random effect may add a further force of the same kind to `p + d`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from avtorch.gap.simulator.effect import Effect

_NO_LAG = 2e-3  # [s] lags below this are not identifiable from a log

NAMES = ("process_sd", "process_time", "force_sd", "force_time", "accel_sd", "speed_sd")


@dataclass(frozen=True)
class NoiseModel:
    """`process_sd`, `force_sd`, `accel_sd` [m/s²], `speed_sd` [m/s] (white, of single rows), times [s]. `more_sd`,
    `more_time`: of a random effect's force, absent at 0.

    The accelerometer measures the car's random motion scaled by `sensor_scale` [-] and lagged by a first-order
    `sensor_lag` [s].
    """

    process_sd: float = 0.05
    process_time: float = 0.35
    force_sd: float = 0.01
    force_time: float = 3.0
    accel_sd: float = 0.05
    speed_sd: float = 0.02
    sensor_scale: float = 1.0
    sensor_lag: float = 0.0
    more_sd: float = 0.0
    more_time: float = 1.0

    @property
    def forces(self) -> tuple[tuple[float, float], ...]:
        """Standard deviations [m/s²] and time constants [s] of the random motion's components."""
        more = ((self.more_sd, self.more_time),) if self.more_sd > 0 else ()
        return ((self.process_sd, self.process_time), (self.force_sd, self.force_time), *more)

    @property
    def jerk_sd(self) -> float:
        """A plant's `sigma` [m/s³], whose white jerk has the standard deviation `process_sd` behind the lag."""
        return float(self.process_sd * np.sqrt(2 / self.process_time))

    def replaced(self, **values: float) -> NoiseModel:
        return replace(self, **values)

    def seen_through(self, effects: Iterable[type[Effect]], values: Mapping[str, float]) -> NoiseModel:
        """The noise as measured by the accelerometer that `effects` describe at parameter `values`, by key."""
        lag, scale = 0.0, 1.0
        for e in effects:
            if "lag" in e.reading:
                lag = values[f"{e.name}.{e.reading['lag']}"]
            if "scale" in e.reading:
                scale = values[f"{e.name}.{e.reading['scale']}"]
        return replace(self, sensor_scale=scale, sensor_lag=lag if lag > _NO_LAG else 0.0)

    def of_means(self, group: int) -> NoiseModel:
        """The noise of means over `group` rows."""
        size = float(np.sqrt(group))
        return replace(self, accel_sd=self.accel_sd / size, speed_sd=self.speed_sd / size)
