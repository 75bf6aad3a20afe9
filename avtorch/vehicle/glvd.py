r"""The generalised linear vehicle dynamics (GLVD), Eq. 1 of the paper:

    da/dt = -a / T_L + (K_L / T_L) u + eps

`T_L` [s] actuation lag, `K_L` [-] realised fraction of the demanded acceleration, `a` realised and `u` demanded
acceleration [m/s²], `eps` jerk noise [m/s³]. Over a step `dt` in which `u` is held both discretisations read
`a⁺ = alpha a + K_L (1 - alpha) u`:

- `"zoh"`, exact zero-order hold: `alpha = exp(-dt / T_L)`;
- `"euler"`, what the paper's simulation does: `alpha = 1 - dt / T_L` (diverges where `dt > 2 T_L`).

The functions are the hot path and do not check values (so they also run under `torch.func`): `GLVD` and the plant check
their parameters once. Everything broadcasts over leading dimensions and keeps the dtype of the tensors given.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from avtorch.arrays import Float, Real
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Batched, Number, broadcast_shape, checked

Method = Literal["zoh", "euler"]


def _decay(T_L: Tensor, dt: Number, method: str) -> tuple[Tensor, Tensor]:
    """`alpha` and `1 - alpha`; the second never by subtraction, which would cost digits where dt is small."""
    ratio = dt / T_L
    if method == "zoh":
        return torch.exp(-ratio), -torch.expm1(-ratio)
    if method == "euler":
        return 1 - ratio, ratio
    raise InputError(f'method: found {method!r}, needs "zoh" or "euler"')


def _with_dtype(a: object, u: object, T_L: object, K_L: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """All four as tensors; Python numbers take the dtype of the tensors beside them, float64 if there are none."""
    given = [x for x in (a, u, T_L, K_L) if isinstance(x, Tensor) and x.is_floating_point()]
    dtype = torch.float64
    if given:
        dtype = given[0].dtype
        for x in given[1:]:
            dtype = torch.promote_types(dtype, x.dtype)
    device = given[0].device if given else None
    out = [x if isinstance(x, Tensor) else torch.as_tensor(x, dtype=dtype, device=device) for x in (a, u, T_L, K_L)]
    return out[0], out[1], out[2], out[3]


def _check_dt(dt: Number) -> None:
    if not isinstance(dt, Tensor) and not 0 < dt < float("inf"):
        raise InputError(f"dt: found {dt!r}, needs a finite time step > 0 s")


def glvd_jerk(a: Batched, u: Batched, T_L: Batched, K_L: Batched) -> Float[Tensor, "*batch"]:
    """Noise-free jerk `(K_L u - a) / T_L` [m/s³] (Eq. 1); all arguments broadcast."""
    a, u, lag, gain = _with_dtype(a, u, T_L, K_L)
    return (gain * u - a) / lag


def glvd_step(
    a: Batched, u: Batched, T_L: Batched, K_L: Batched, dt: Number, *, method: Method = "zoh"
) -> Float[Tensor, "*batch"]:
    """Acceleration [m/s²] after one step of `dt` [s] with `u` held; all arguments broadcast.

    Raises `InputError` for an unknown `method` or a `dt` that is no positive number.

    Example:
        >>> from avtorch.vehicle import glvd_step
        >>> [float(glvd_step(0.0, 1.0, 0.3, 1.0, dt=0.3, method=m).round(decimals=3)) for m in ("zoh", "euler")]
        [0.632, 1.0]
    """
    _check_dt(dt)
    a, u, lag, gain = _with_dtype(a, u, T_L, K_L)
    alpha, rest = _decay(lag, dt, method)
    return alpha * a + rest * (gain * u)


def glvd_rollout(
    a0: Batched, u: Real[Tensor, "*#batch time"], T_L: Batched, K_L: Batched, dt: Number, *, method: Method = "zoh"
) -> Float[Tensor, "*batch time"]:
    """Accelerations [m/s²] at steps 1…N from `a0` (...) under commands `u` (..., time), each held for `dt` [s].

    Args: `a0`, `T_L`, `K_L` of any shapes that broadcast with `u.shape[:-1]`. Returns (..., time).

    The recursion is a linear scan with one constant factor, so it is doubled, not stepped: after pass `j` every
    entry holds the sum over its last 2^j inputs. log2(N) passes over whole tensors instead of N small steps, no
    truncation, and products only (no division by powers of alpha), so that gradients of any order stay finite
    where alpha is 0 or negative (Euler) or underflows.

    Raises `InputError` for an unknown `method`, a `dt` that is no positive number, or a `u` without time dimension.
    """
    _check_dt(dt)
    a0, u, lag, gain = _with_dtype(a0, u, T_L, K_L)
    if u.dim() == 0:
        raise InputError("u: found a single number, needs commands along a last dimension of time")
    alpha, rest = _decay(lag, dt, method)
    x = (rest * gain).unsqueeze(-1) * u
    first = alpha * a0
    x = x.expand(broadcast_shape(x.shape, (*first.shape, 1)))
    steps = x.shape[-1]
    if steps == 0:
        return x
    first = first.expand(x.shape[:-1]).unsqueeze(-1)
    x = torch.cat([x[..., :1] + first, x[..., 1:]], dim=-1)
    power, reach = alpha.unsqueeze(-1), 1
    while reach < steps:
        x = torch.cat([x[..., :reach], x[..., reach:] + power * x[..., :-reach]], dim=-1)
        reach *= 2
        # exp(-reach dt/T) rather than repeated squaring: keeps float32 accurate to its last digits
        power = torch.exp(-reach * dt / lag).unsqueeze(-1) if method == "zoh" else power * power
    return x


def motion_coefficients(
    T_L: Float[Tensor, "*#batch"], dt: float | Float[Tensor, "*#batch"]
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """`(alpha, m1, m2)`: a step's exact share of `a - a_inf` in acceleration [-], speed [s] and position [s²]."""
    ratio = dt / T_L
    m1 = -T_L * torch.expm1(-ratio)
    # T (dt - m1) cancels where dt << T; its series (next term dt⁴/T², relative 1e-10 at the switch) does not
    series = dt * dt * (0.5 - ratio / 6 + ratio**2 / 24 - ratio**3 / 120)
    return torch.exp(-ratio), m1, torch.where(ratio < 0.02, series, T_L * (dt - m1))


class GLVD(torch.nn.Module):
    """Eq. 1 as a differentiable module with parameters `T_L` [s] > 0 and `K_L` [-] >= 0 of any batch shape.

    Floats become float64 parameters, tensors keep their dtype (`module.float()` converts). `K_L = 0` is allowed:
    an actuator that ignores its command. Raises `InputError` for `T_L <= 0`, `K_L < 0`, non-finite values or shapes
    that do not broadcast.

    Example:
        >>> import torch
        >>> from avtorch import GLVD
        >>> car = GLVD(T_L=0.3, K_L=1.0)
        >>> a = car.rollout(0.0, torch.ones(100, dtype=torch.float64), dt=0.01)
        >>> a[-1].backward()
        >>> round(a[-1].item(), 4), round(car.T_L.grad.item(), 4)  # after 1 s, and its slope in the lag
        (0.9643, -0.3964)
    """

    def __init__(self, T_L: Number, K_L: Number) -> None:
        super().__init__()
        like = T_L if isinstance(T_L, Tensor) and T_L.is_floating_point() else K_L
        dtype = like.dtype if isinstance(like, Tensor) and like.is_floating_point() else None
        lag = checked("T_L", T_L, unit="s", above=0.0, dtype=dtype)
        gain = checked("K_L", K_L, least=0.0, dtype=dtype)
        try:
            broadcast_shape(lag.shape, gain.shape)
        except RuntimeError:
            raise InputError(
                f"K_L: found shape {tuple(gain.shape)}, needs one that broadcasts with T_L {tuple(lag.shape)}"
            ) from None
        self.T_L = torch.nn.Parameter(lag.detach().clone())
        self.K_L = torch.nn.Parameter(gain.detach().clone())

    def jerk(self, a: Number, u: Number) -> Float[Tensor, "*all"]:
        """Noise-free jerk [m/s³]; `a`, `u` [m/s²] broadcast with the parameters."""
        return glvd_jerk(a, u, self.T_L, self.K_L)

    def step(self, a: Number, u: Number, dt: Number, *, method: Method = "zoh") -> Float[Tensor, "*all"]:
        """Acceleration after one step of `dt` [s]; see `glvd_step`."""
        return glvd_step(a, u, self.T_L, self.K_L, dt, method=method)

    def rollout(
        self, a0: Number, u: Real[Tensor, "*#batch time"], dt: Number, method: Method = "zoh"
    ) -> Float[Tensor, "*all time"]:
        """Accelerations at steps 1…N along the last dimension; see `glvd_rollout`."""
        return glvd_rollout(a0, u, self.T_L, self.K_L, dt, method=method)

    forward = rollout
