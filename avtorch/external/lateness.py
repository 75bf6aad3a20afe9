"""How late a plant answers, whatever makes it late: lag, dead time, the actuator's own dynamics."""

from __future__ import annotations

import numpy as np
from scipy.integrate import trapezoid

from avtorch.arrays import FloatArray
from avtorch.external.discrepancy import responses
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

_STEP_MPS2, _RATE_HZ = 0.5, 100
_BEFORE_S, _AFTER_S, _SETTLED_S = 1.0, 9.0, 1.0


def lateness(plant: GapPlant, speed: float) -> float:
    """Mean delay [s] of the acceleration that answers a step in the command, at a speed [m/s].

    It is the area between the step and its answer, over the answer's height: `T_L` for GLVD, and the sum of the delays
    of all that the command passes. At least `T_L`, also for a plant that does not answer a step of 0.5 m/s².

    Example:
        >>> from avtorch.external.lateness import lateness
        >>> from avtorch.gap import DeadTime, plant
        >>> round(lateness(plant([DeadTime(0.2)], T_L=0.3), 20.0), 2)
        0.5
    """
    time = np.arange(round((_BEFORE_S + _AFTER_S) * _RATE_HZ)) / _RATE_HZ
    step = np.where(time < _BEFORE_S, 0.0, _STEP_MPS2)
    still = 0.0 * time

    def accel(command: FloatArray) -> FloatArray:
        drive = Log.from_arrays(time=time, accel_cmd=command, accel=still, speed=still + max(speed, 1.0))
        return responses(drive, plant)["accel"]

    # without the forces that act whatever the command
    answer = accel(step) - accel(still)
    height = float(answer[-round(_SETTLED_S * _RATE_HZ) :].mean())
    least = float(plant.T_L)
    if abs(height) < 1e-3 * _STEP_MPS2:
        return least
    after = time >= _BEFORE_S
    return max(float(trapezoid(1.0 - answer[after] / height, dx=1 / _RATE_HZ)), least)
