"""The lower level: turns the demanded acceleration into the command sent, by inverting a model of the actuator.

With a model `(T_hat, K_hat)` and a target `(T_d, K_d)` it sends

    u_cmd = (T_hat / K_hat) [ (1/T_hat - 1/T_d) a + (K_d / T_d) u ]

clipped to the vehicle's limits, so that a plant equal to the model answers `u` like a GLVD with `(T_d, K_d)`.
Adjusting `T_hat`, `K_hat` here is Strategy 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Batch, Batched, Number, checked, tensor


@dataclass(frozen=True)
class LowerLevel:
    """Model `(T_hat [s], K_hat [-])`, target `(T_d [s], K_d [-])`, limits [m/s²]; floats or tensors (scenario,).

    Frozen: a new setting is a new object (`dataclasses.replace`). Raises `InputError` unless lags and gains are
    > 0 and `accel_min < accel_max`.

    Example:
        >>> import torch
        >>> from avtorch import LowerLevel
        >>> inverse = LowerLevel(T_hat=1.5, K_hat=0.5)  # knows the degraded actuator, aims at the nominal one
        >>> round(float(inverse.command(a=torch.tensor(0.0), u=torch.tensor(0.2))), 3), float(inverse.amplification())
        (2.0, 10.0)
        >>> [round(float(x), 3) for x in inverse.effective(1.5, 0.5)]
        [0.3, 1.0]
    """

    T_hat: Number = 0.3
    K_hat: Number = 1.0
    T_d: Number = 0.3
    K_d: Number = 1.0
    accel_min: Number = -6.0
    accel_max: Number = 4.0
    _on_accel: Tensor = field(init=False, repr=False, compare=False)
    _on_demand: Tensor = field(init=False, repr=False, compare=False)
    _limits: tuple[Tensor, Tensor] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        T_hat = checked("T_hat", self.T_hat, unit="s", above=0.0)
        K_hat = checked("K_hat", self.K_hat, above=0.0)
        T_d = checked("T_d", self.T_d, unit="s", above=0.0)
        K_d = checked("K_d", self.K_d, above=0.0)
        low, high = checked("accel_min", self.accel_min), checked("accel_max", self.accel_max)
        if bool((low >= high).any()):
            raise InputError(f"accel_min: found {self.accel_min} with accel_max {self.accel_max}, needs a lower value")
        # written so that T_hat = T_d, K_hat = K_d gives exactly 0 and 1: u passes through unchanged
        on_accel, on_demand = (1 - T_hat / T_d) / K_hat, (T_hat * K_d) / (K_hat * T_d)
        object.__setattr__(self, "_on_accel", on_accel)
        object.__setattr__(self, "_on_demand", on_demand)
        object.__setattr__(self, "_limits", (low, high))

    def raw_command(self, a: Batch, u: Batch) -> Float[Tensor, "*all"]:
        """The command before clipping [m/s²] for measured acceleration `a` and demand `u` [m/s²], (..., scenario)."""
        return torch.addcmul(self._on_accel * a, self._on_demand, u)

    def clip(self, raw: Batch) -> Float[Tensor, "*all"]:
        """`raw` [m/s²] within the vehicle's limits."""
        return torch.clamp(raw, *self._limits)

    def at_limit(self, command: Float[Tensor, "*batch"]) -> Bool[Tensor, "*batch"]:
        """Where a command is at the vehicle's limits, clipped here or limited by the controller (an MPC), bool."""
        low, high = self._limits
        slack = 1e-6  # [m/s²], tolerance of a solver
        return (command <= low + slack) | (command >= high - slack)

    def command(self, a: Batch, u: Batch) -> Float[Tensor, "*all"]:
        """The command actually sent [m/s²]: `raw_command`, clipped. This is what the estimator takes as `u`."""
        return self.clip(self.raw_command(a, u))

    def amplification(self) -> Float[Tensor, "*setting"]:
        """Command effort `T_hat K_d / (K_hat T_d)` [-]: the amplification of a fast demand."""
        return self._on_demand

    def effective(self, T_L: Batched, K_L: Batched) -> tuple[Float[Tensor, "*all"], Float[Tensor, "*all"]]:
        """Effective `(T_e [s], K_e [-])` of the unclipped loop with a plant `(T_L, K_L)`; broadcasts.

        `1/T_e = 1/T - r (1/T_hat - 1/T_d)`, `r = K T_hat / (T K_hat)`. Where the model overestimates the plant, `1/T_e`
        can be zero or negative: the inner loop is then itself unstable and `T_e` is infinite or negative, which every
        verdict counts as unstable.
        """
        T, K = tensor(T_L), tensor(K_L)
        r_over_T_hat = K / (T * self.K_hat)
        rate = 1 / T - r_over_T_hat * (1 - tensor(self.T_hat) / self.T_d)
        return 1 / rate, r_over_T_hat * self.T_hat * self.K_d / (rate * self.T_d)
