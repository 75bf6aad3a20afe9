"""One setting of the loop: actuation, time gap, gains and dead time, brought to one dtype and ready to broadcast."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Real
from avtorch.errors import InputError
from avtorch.vehicle.arguments import broadcast_shape

Value = float | Sequence[float] | Real[Tensor, "*#setting"]
Gains = Sequence[float] | Real[Tensor, "*#setting 3"]
Loose = float | Sequence[float] | Tensor


@dataclass(frozen=True)
class LinearLoop:
    """A loop around `A (T s + 1) = K exp(-theta s) u`, every field a tensor that broadcasts with the others.

    `valid` is False where the actuation is no vehicle: T_L < 0, K_L <= 0 or anything not finite. Such entries come from
    a lower level whose inverted model makes the loop unstable (effective T_L infinite or negative) and
    hold placeholder numbers so that nothing becomes NaN, and every verdict on them is "unstable".
    T_L = 0, the paper's ideal actuator, is valid and means the limit from above.
    """

    T: Float[Tensor, "*#setting"]
    K: Float[Tensor, "*#setting"]
    tau: Float[Tensor, "*#setting"]
    ks: Float[Tensor, "*#setting"]
    kv: Float[Tensor, "*#setting"]
    ka: Float[Tensor, "*#setting"]
    theta: Float[Tensor, "*#setting"]
    kf: Float[Tensor, "*#setting"]
    theta_f: Float[Tensor, "*#setting"]
    valid: Bool[Tensor, "*#setting"]

    @property
    def g(self) -> Float[Tensor, "*setting"]:
        """Total speed gain g = k_s tau + k_v [1/s]."""
        return self.ks * self.tau + self.kv

    @property
    def b(self) -> Float[Tensor, "*setting"]:
        """Coefficient of s^2 without dead time, 1 - K k_a [-]."""
        return 1 - self.K * self.ka

    @property
    def shape(self) -> torch.Size:
        return broadcast_shape(*(getattr(self, f.name).shape for f in fields(self)))

    def full(self, x: Tensor) -> Tensor:
        """`x` broadcast to the shape of the whole setting."""
        return x.expand(self.shape)

    def map(self, change: Callable[[Tensor], Tensor]) -> LinearLoop:
        """The setting with `change` applied to every field."""
        return LinearLoop(*(change(getattr(self, f.name)) for f in fields(self)))

    def pick(self, mask: Bool[Tensor, "*setting"]) -> LinearLoop:
        """The entries where `mask` (of the full shape) holds, as a flat (setting,) batch."""
        mask = mask.reshape(1) if mask.ndim == 0 else mask
        return self.map(lambda x: x.expand(mask.shape)[mask])

    def column(self) -> LinearLoop:
        """The same batch with a trailing axis for frequencies."""
        return self.map(lambda x: x.unsqueeze(-1))


def as_tensor(x: Loose, like: Sequence[Loose], name: str) -> Tensor:
    """`x` as a floating tensor: the dtype and device of the floating tensors in `like`, else float64 (ints too)."""
    given = [t for t in like if isinstance(t, Tensor)]
    floating = [t.dtype for t in given if t.is_floating_point()]
    dtype = floating[0] if floating else torch.float64
    for other in floating[1:]:
        dtype = torch.promote_types(dtype, other)
    try:
        return torch.as_tensor(x, dtype=dtype, device=given[0].device if given else None)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{name}: expected a number or a tensor of numbers, found {type(x).__name__}") from error


def linear_loop(
    T_L: Value,
    K_L: Value,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Value = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> LinearLoop:
    """Check and gather the arguments that every stability function takes.

    T_L [s], K_L [-], time_gap [s], dead_time [s], feedforward k_f [-] and its delay [s] broadcast with each other and
    with the leading dimensions of gains (..., 3) = (k_s [1/s^2], k_v [1/s], k_a [-]).

    Raises InputError for gains without a last dimension of 3, shapes that do not broadcast, and a dead time or delay
    that is negative or not finite.
    """
    given = {
        "T_L": T_L,
        "K_L": K_L,
        "time_gap": time_gap,
        "gains": gains,
        "dead_time": dead_time,
        "feedforward": feedforward,
        "feedforward_delay": feedforward_delay,
    }
    like = list(given.values())
    T, K, tau, k, theta, kf, theta_f = (as_tensor(x, like, name) for name, x in given.items())
    if k.ndim == 0 or k.shape[-1] != 3:
        raise InputError(f"gains: expected (k_s, k_v, k_a) on the last dimension, found shape {tuple(k.shape)}")
    for name, delay in (("dead_time", theta), ("feedforward_delay", theta_f)):
        if not bool((torch.isfinite(delay) & (delay >= 0)).all()):
            raise InputError(f"{name}: expected finite seconds >= 0, found {_first_bad(delay)}")
    try:
        broadcast_shape(T.shape, K.shape, tau.shape, k.shape[:-1], theta.shape, kf.shape, theta_f.shape)
    except RuntimeError as error:
        found = zip(given, (T, K, tau, k, theta, kf, theta_f), strict=True)
        shapes = ", ".join(f"{name} {tuple(x.shape)}" for name, x in found)
        raise InputError(f"shapes do not broadcast (gains without its last dimension): {shapes}") from error
    ks, kv, ka = k.unbind(-1)
    actuator = torch.isfinite(T) & torch.isfinite(K) & (T >= 0) & (K > 0)
    law = torch.isfinite(tau) & torch.isfinite(k).all(-1) & torch.isfinite(kf)
    one = torch.ones((), dtype=T.dtype, device=T.device)
    # Placeholders by torch.where, on each side separately, keep values and gradients finite and the shapes small.
    lag, share = (torch.where(actuator, x, one) for x in (T, K))
    tau, ks, kv, ka, kf = (torch.where(torch.isfinite(x), x, one) for x in (tau, ks, kv, ka, kf))
    return LinearLoop(lag, share, tau, ks, kv, ka, theta, kf, theta_f, actuator & law)


def _first_bad(delay: Tensor) -> float:
    flat = delay.reshape(-1)
    return float(flat[~(torch.isfinite(flat) & (flat >= 0))][0])
