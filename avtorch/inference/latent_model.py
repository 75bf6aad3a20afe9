r"""The latent-acceleration model and its exact discretisation (SPEC section 3, latent form).

State ``(v, a, d)``: speed, actuator acceleration, external acceleration that the simulator does not know.

.. math::
    \dot v = a + d + g\, w_3, \qquad \dot a = -a/T_L + (K_L/T_L)\, u + q\, w_1, \qquad
    \dot d = -d/\tau_d + s \sqrt{2/\tau_d}\, w_2

with ``w`` unit white noise. ``d`` is Ornstein-Uhlenbeck with stationary SD ``s`` and carries the coloured
residual. ``g`` is road noise: vibration of the body that the wheels see, faster than the rows. Without it the mode
``T_L → 0`` with a huge ``q`` imitates it, on a recorded lap by hundreds of nats, and drags the lag to nothing.
Measured are ``v`` and/or ``a + d``, each with independent noise per row. The command is held between rows. ``a`` and
``d`` drive ``v`` independently, so every entry has a closed form and no matrix exponential is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

#: Prior standard deviation of the first speed about the first measured one [m/s]: as good as diffuse.
SPEED_SD0 = 10.0
#: Prior standard deviation of the first actuator acceleration about zero [m/s²]: wider than what cars do in ACC use.
ACCEL_SD0 = 3.0

# Below this x the closed form of _integral_squared cancels; the series is exact there to round-off.
_SERIES_BELOW = 0.5
_SERIES = tuple((-1) ** (k + 1) * (2.0 ** (k - 1) - 2.0) / math.factorial(k) for k in range(3, 21))


@dataclass(frozen=True)
class Step:
    """One exact step: ``x⁺ = transition x + gain u + N(0, noise)``.

    Shapes ``(..., 3, 3)``, ``(..., 3)``, ``(..., 3, 3)`` over the state ``(v, a, d)``.
    """

    transition: Tensor
    gain: Tensor
    noise: Tensor


def _integral_squared(x: Tensor) -> Tensor:
    """``x - 2(1 - e^-x) + (1 - e^-2x)/2``, the variance of an integrated OU process in its own units; ~x³/3."""
    small = x < _SERIES_BELOW
    xs = torch.where(small, x, torch.zeros_like(x))
    xl = torch.where(small, torch.ones_like(x), x)
    series = torch.zeros_like(xs)
    for coefficient in reversed(_SERIES):
        series = series * xs + coefficient
    closed = xl + 2.0 * torch.expm1(-xl) - 0.5 * torch.expm1(-2.0 * xl)
    return torch.where(small, series * xs**3, closed)


def _ou(time: Tensor, density: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Decay, reach into the speed, and the three noise moments of an OU process and its integral over ``dt``.

    ``time`` [s] its time constant, ``density`` the squared intensity of the white noise that drives it.
    """
    x = dt / time
    decay = torch.exp(-x)
    lost = -torch.expm1(-x)
    variance = -0.5 * density * time * torch.expm1(-2.0 * x)
    cross = 0.5 * density * (time * lost) ** 2
    integral = density * time**3 * _integral_squared(x)
    return decay, time * lost, variance, cross, integral


def discretise(
    T_L: Tensor,
    K_L: Tensor,
    process_noise: Tensor,
    road_noise: Tensor,
    coloured_sd: Tensor,
    coloured_time: Tensor,
    dt: Tensor,
) -> Step:
    """Exact discretisation with the command held over ``dt``; all arguments broadcast to ``(...)``.

    Units: ``T_L`` [s], ``K_L`` [-], ``process_noise`` [m/s²/√s], ``road_noise`` [m/s/√s], ``coloured_sd``
    [m/s²], ``coloured_time`` [s], ``dt`` [s].
    """
    T_L, K_L, process_noise, road_noise, coloured_sd, coloured_time, dt = torch.broadcast_tensors(
        T_L, K_L, process_noise, road_noise, coloured_sd, coloured_time, dt
    )
    ea, reach_a, aa, va, vv_a = _ou(T_L, process_noise**2, dt)
    ed, reach_d, dd, vd, vv_d = _ou(coloured_time, 2.0 * coloured_sd**2 / coloured_time, dt)
    one, zero = torch.ones_like(dt), torch.zeros_like(dt)
    transition = torch.stack((one, reach_a, reach_d, zero, ea, zero, zero, zero, ed), -1).unflatten(-1, (3, 3))
    gain = torch.stack((K_L * (dt - reach_a), -K_L * torch.expm1(-dt / T_L), zero), -1)
    vv = vv_a + vv_d + road_noise**2 * dt
    noise = torch.stack((vv, va, vd, va, aa, zero, vd, zero, dd), -1).unflatten(-1, (3, 3))
    return Step(transition, gain, noise)


def initial_covariance(coloured_sd: Tensor) -> Tensor:
    """Covariance ``(..., 3, 3)`` of ``(v, a, d)`` at the first row, before its measurement.

    The mean is (first measured speed, 0, 0). ``v`` is nearly diffuse, so that its centre carries no information; ``a``
    is broad, because a window may start anywhere in a drive, after unknown commands; ``d`` is stationary.
    """
    one = torch.ones_like(coloured_sd)
    return torch.diag_embed(torch.stack((one * SPEED_SD0**2, one * ACCEL_SD0**2, coloured_sd**2), -1))
