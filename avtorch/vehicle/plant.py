"""The plant: the car's response to the command over one step.

A plant is an object with `step(a, v, u, dt, eps)` (or a callable of the same arguments) that returns acceleration,
speed and displacement after `dt`; (..., scenario) tensors, no standstill logic. Three optional members: `sigma`
[m/s³], the scale of the jerk noise the loop draws for it (none: 0); `jerk(a, u)`, the noise-free jerk at a row,
without which the log's jerk is unknown (NaN), never a difference of accelerations; and `speed_reading(a, v)`, what
controller and log see of the speed (none: `v`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Batch, Number, checked
from avtorch.vehicle.glvd import Method, motion_coefficients

Motion = tuple[Tensor, Tensor, Tensor]


class Plant(Protocol):
    """The interface that the loop needs of a plant."""

    def step(self, a: Batch, v: Batch, u: Batch, dt: float, eps: Batch) -> Motion:
        """Acceleration [m/s²], speed [m/s] and displacement [m] after `dt` [s], command `u` and noise `eps` held."""
        ...


PlantFunction = Callable[[Tensor, Tensor, Tensor, float, Tensor], Motion]


@dataclass(frozen=True)
class GLVDPlant:
    """Eq. 1 with jerk noise `eps ~ N(0, sigma²)`, one draw per step, held over it; floats or tensors (scenario,).

    `"zoh"` integrates acceleration, speed and position exactly; `"euler"` is the paper's explicit step. `accel_min`
    and `accel_max` [m/s²] bound what the vehicle can physically follow: `K_L u` is clipped to them (the log does not
    show this; it still contains the command sent). Frozen: another car is another object. Raises `InputError` for `T_L
    <= 0`, `K_L < 0`, `sigma < 0`, non-finite values or crossed limits.

    Example:
        >>> import torch
        >>> from avtorch import GLVDPlant
        >>> plant = GLVDPlant(T_L=0.3, K_L=1.0, accel_max=2.0)  # an engine that gives no more than 2 m/s²
        >>> a, u = torch.tensor(1.4, dtype=torch.float64), torch.tensor([1.7, 3.0], dtype=torch.float64)
        >>> plant.jerk(a, u).round(decimals=3).tolist()
        [1.0, 2.0]
    """

    T_L: Number = 0.3
    K_L: Number = 1.0
    sigma: Number = 0.1
    method: Method = "zoh"
    accel_min: float | None = None
    accel_max: float | None = None
    _lag: Tensor = field(init=False, repr=False, compare=False)
    _gain: Tensor = field(init=False, repr=False, compare=False)
    _coefficients: dict[float, tuple[Tensor, Tensor, Tensor]] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_lag", checked("T_L", self.T_L, unit="s", above=0.0))
        object.__setattr__(self, "_gain", checked("K_L", self.K_L, least=0.0))
        checked("sigma", self.sigma, unit="m/s³", least=0.0)
        if self.method not in ("zoh", "euler"):
            raise InputError(f'method: found {self.method!r}, needs "zoh" or "euler"')
        low = -torch.inf if self.accel_min is None else self.accel_min
        if not low < (torch.inf if self.accel_max is None else self.accel_max):
            raise InputError(f"accel_min: found {self.accel_min} with accel_max {self.accel_max}, needs a lower value")
        object.__setattr__(self, "_coefficients", {})

    def target(self, u: Batch) -> Float[Tensor, "*all"]:
        """Steady-state acceleration under a held `u`, without noise: `K_L u` within the physical limits [m/s²]."""
        wanted = self._gain * u
        if self.accel_min is None and self.accel_max is None:
            return wanted
        return torch.clamp(wanted, self.accel_min, self.accel_max)

    def jerk(self, a: Batch, u: Batch) -> Float[Tensor, "*all"]:
        """Noise-free instantaneous jerk [m/s³]."""
        return (self.target(u) - a) / self._lag

    def step(self, a: Batch, v: Batch, u: Batch, dt: float, eps: Batch) -> Motion:
        """See `Plant.step`."""
        if self.method == "euler":
            return a + dt * (self.jerk(a, u) + eps), v + dt * a, dt * v
        if dt not in self._coefficients:  # saves a few operations per step; the object is frozen, so they stay valid
            self._coefficients[dt] = motion_coefficients(self._lag, dt)
        alpha, m1, m2 = self._coefficients[dt]
        a_inf = torch.addcmul(self.target(u), self._lag, eps)
        d = a - a_inf
        speed = torch.addcmul(torch.add(v, a_inf, alpha=dt), m1, d)
        moved = torch.addcmul(torch.add(v * dt, a_inf, alpha=0.5 * dt * dt), m2, d)
        return torch.addcmul(a_inf, alpha, d), speed, moved
