"""The interface of a model for a joint Kalman filter: transition and observation of the mean, both differentiable, and
noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

from torch import Tensor

from avtorch.arrays import Float


class GaussianState(NamedTuple):
    """A normal state: ``mean`` ``(vehicle, d)``, ``cov`` ``(vehicle, d, d)``; the last two are ``log T_L, log K_L``."""

    mean: Float[Tensor, "vehicle d"]
    cov: Float[Tensor, "vehicle d d"]


@dataclass(frozen=True)
class Observation:
    """One row of every vehicle.

    ``u`` and ``a``: demanded and, where it is known exactly, realised acceleration [m/s²], ``(vehicle,)``;
    ``measured``: ``(vehicle, channel)``; ``dt``: to the next row [s].
    """

    u: Float[Tensor, " vehicle"]
    a: Float[Tensor, " vehicle"]
    measured: Float[Tensor, "vehicle channel"]
    dt: Float[Tensor, ""]


class StateModel(Protocol):
    """A state-space model, batched over vehicles; ``x`` is ``(..., vehicle, d)``."""

    @property
    def variance(self) -> Float[Tensor, "vehicle channel"]:
        """Variance of every channel's noise, ``(vehicle, channel)``."""
        ...

    def start(self, actuation: GaussianState, row: Observation) -> GaussianState:
        """The state at the first row of a run, given the belief in ``(log T_L, log K_L)``."""
        ...

    def advance(self, x: Float[Tensor, "*point vehicle d"], row: Observation) -> Float[Tensor, "*point vehicle d"]:
        """The state a step later without noise, shape of ``x``."""
        ...

    def slope(self, x: Float[Tensor, "*point vehicle d"], row: Observation) -> Float[Tensor, "*point vehicle d d"]:
        """Derivative of :meth:`advance`, ``(..., vehicle, d, d)``."""
        ...

    def noise(self, x: Float[Tensor, "vehicle d"], row: Observation) -> Float[Tensor, "*vehicle d d"]:
        """Covariance of the step's noise, ``(vehicle, d, d)``, at ``x`` ``(vehicle, d)``."""
        ...

    def observe(
        self, x: Float[Tensor, "*point vehicle d"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle"]:
        """The channel's reading without noise, ``(..., vehicle)``."""
        ...

    def observed_slope(
        self, x: Float[Tensor, "*point vehicle d"], row: Observation, channel: int
    ) -> Float[Tensor, "*point vehicle d"]:
        """Derivative of :meth:`observe`, ``(..., vehicle, d)``."""
        ...
