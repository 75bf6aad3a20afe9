"""Effect of a model's errors in the closed loop: the resulting errors of speed and spacing behind a leader.

A controller feeds errors back, so a model's open-loop errors differ from those of a simulated platoon. With the
actuator `P = K_L / (T_L s + 1)` and the linear controller, an error `e` of the speed in an open-loop rollout becomes,
in the loop,

    speed    e s^2 / (s^2 + P (k_s + g s - k_a s^2)),    g = k_s tau + k_v
    spacing  minus its integral

by superposition: the loop is linear, and the leader is the same for car and model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import bilinear, lfilter

from avtorch.arrays import FloatArray
from avtorch.vehicle.controllers import NOMINAL_GAINS

_LEAST_DECAY = 0.02  # [1/s] a loop that decays more slowly does not forget its past within a block


@dataclass(frozen=True)
class ClosedLoopMetric:
    """Closed-loop error of `quantity` ("speed" [m/s] or "spacing" [m]), computed from errors of a `channel`.

    `T_L` [s], `K_L`: of the car in the loop. Controller: constant time gap `time_gap` [s], `gains` (k_s, k_v, k_a).
    """

    channel: str
    quantity: str
    T_L: float
    K_L: float
    time_gap: float = 1.0
    gains: Sequence[float] = NOMINAL_GAINS

    horizon_s = float("inf")  # no restarts, as in the measure over the whole drive

    @property
    def name(self) -> str:
        return f"closed_loop_rmse_{self.quantity}"

    @cached_property
    def _transfer(self) -> tuple[list[float], list[float]]:
        """Numerator and denominator in s of the transfer function from the speed's error."""
        k_s, k_v, k_a = self.gains
        K = self.K_L
        below = [self.T_L, 1.0 - K * k_a, K * (k_s * self.time_gap + k_v), K * k_s]
        above = [self.T_L, 1.0, 0.0, 0.0] if self.quantity == "speed" else [-self.T_L, -1.0, 0.0]
        return above, below

    @property
    def stable(self) -> bool:
        """Whether the loop is stable and decays fast enough."""
        return bool(np.roots(self._transfer[1]).real.max() < -_LEAST_DECAY)

    def products(self, x: FloatArray, blocks: Sequence[slice], dt: float, lag: float) -> FloatArray:
        """(block, one, other): sums over each block of products of closed-loop errors.

        Computed from errors of long rollouts, `x` (one, row); `dt` [s] between rows. `lag` is unused: the loop has its
        own.
        """
        off = self.of(x, dt)
        return np.stack([off[:, b] @ off[:, b].T for b in blocks])

    def of(self, errors: FloatArray, dt: float) -> FloatArray:
        """Closed-loop errors (..., row) from those of a long rollout (..., row); both are zero at the first row.

        `dt` [s] between rows.
        """
        off = errors
        if self.channel == "accel":
            gained = np.cumsum(0.5 * dt * (errors[..., 1:] + errors[..., :-1]), -1)
            off = np.concatenate([np.zeros_like(errors[..., :1]), gained], -1)
        above, below = bilinear(*self._transfer, fs=1 / dt)
        return np.asarray(lfilter(above, below, off - off[..., :1], axis=-1))


def closed_loop_metrics(channels: Sequence[str], T_L: float, K_L: float) -> tuple[ClosedLoopMetric, ...]:
    """Speed and spacing behind a leader, from the better motion channel; empty where the loop is not stable."""
    channel = "speed" if "speed" in channels else "accel"
    made = tuple(ClosedLoopMetric(channel, quantity, T_L, K_L) for quantity in ("speed", "spacing"))
    return tuple(m for m in made if m.stable)
