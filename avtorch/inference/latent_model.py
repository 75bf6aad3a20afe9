r"""The latent-acceleration model, its exact discretisation, and its likelihood by a Kalman filter (latent form).

State ``(v, a, c, e)``: the speed that the actuator alone would give, the actuator's acceleration, and two unmodelled
quantities: ``c``, the car's excess speed over ``v``, and its derivative ``e``, an external acceleration.

.. math::
    \dot v = a + g\, w_3, \qquad \dot a = -a/T_L + (K_L/T_L)\, u + q\, w_1, \qquad
    \dot c = e, \qquad \dot e = -\lambda^2 c - 2\lambda e + 2\lambda^{3/2}\sigma_c\, w_2

with ``w`` unit white noise. Measured are the speed ``v + c`` and/or the acceleration ``a + e``, each with independent
noise per row. ``c`` is a Matérn process of smoothness 3/2 with length scale ``coloured_time`` (``lambda = sqrt(3) /
coloured_time``); it carries the coloured residual, and ``coloured_sd`` is the stationary SD of ``e``. On recorded laps
the speed error stays bounded. With an external acceleration that has power down to zero frequency, such as an
Ornstein-Uhlenbeck force, it would drift by metres per second within a minute. That model is less likely by tens of
nats, and it discards the slow part of the response, which determines ``K_L`` best.

``g`` is road noise: vibration in the wheel speeds, faster than the rows. Without it a mode at ``T_L → 0`` with a huge
``q`` imitates it, on a recorded lap with hundreds of nats, and the estimate of the lag goes to zero. ``a`` and ``c``
are independent, so every entry has a closed form and no matrix exponential is needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Batch, Signal

#: Prior standard deviation of the first speed about the first measured one [m/s]: practically diffuse.
SPEED_SD0 = 10.0
#: Prior standard deviation of the first actuator acceleration about zero [m/s²]: wider than the accelerations of cars
#: with ACC.
ACCEL_SD0 = 3.0

# Below this x the closed form of _integral_squared cancels; the series is exact there to round-off.
_SERIES_BELOW = 0.5
_SERIES = tuple((-1) ** (k + 1) * (2.0 ** (k - 1) - 2.0) / math.factorial(k) for k in range(3, 21))


# Measurement rows of the sensors.
SPEED_ROW = (1.0, 0.0, 1.0, 0.0)
ACCEL_ROW = (0.0, 1.0, 0.0, 1.0)


@dataclass(frozen=True)
class Step:
    """One exact step: ``x⁺ = transition x + gain u + N(0, noise)``.

    Shapes ``(..., 4, 4)``, ``(..., 4)``, ``(..., 4, 4)`` over the state ``(v, a, c, e)``.
    """

    transition: Float[Tensor, "*batch 4 4"]
    gain: Float[Tensor, "*batch 4"]
    noise: Float[Tensor, "*batch 4 4"]


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
    T_L: Batch, K_L: Batch, process_noise: Batch, road_noise: Batch, coloured_sd: Batch, coloured_time: Batch, dt: Batch
) -> Step:
    """Exact discretisation with the command held over ``dt``; all arguments broadcast to ``(...)``.

    Units: ``T_L`` [s], ``K_L`` [-], ``process_noise`` [m/s²/√s], ``road_noise`` [m/s/√s], ``coloured_sd``
    [m/s²], ``coloured_time`` [s], ``dt`` [s].
    """
    T_L, K_L, process_noise, road_noise, coloured_sd, coloured_time, dt = torch.broadcast_tensors(
        T_L, K_L, process_noise, road_noise, coloured_sd, coloured_time, dt
    )
    ea, reach, aa, va, vv = _ou(T_L, process_noise**2, dt)
    coloured, cc, ce, ee = _matern(coloured_sd, coloured_time, dt)
    one, zero = torch.ones_like(dt), torch.zeros_like(dt)
    rows = (one, reach, zero, zero, zero, ea, zero, zero, zero, zero, *coloured[:2], zero, zero, *coloured[2:])
    transition = torch.stack(rows, -1).unflatten(-1, (4, 4))
    gain = torch.stack((K_L * (dt - reach), -K_L * torch.expm1(-dt / T_L), zero, zero), -1)
    shaken = vv + road_noise**2 * dt
    noise = torch.stack(
        (shaken, va, zero, zero, va, aa, zero, zero, zero, zero, cc, ce, zero, zero, ce, ee), -1
    ).unflatten(-1, (4, 4))
    return Step(transition, gain, noise)


def _matern(sd: Tensor, length: Tensor, dt: Tensor) -> tuple[tuple[Tensor, ...], Tensor, Tensor, Tensor]:
    """Transition entries row by row and the three noise moments of ``(c, e)`` over ``dt``; ``sd`` is that of ``e``."""
    rate = math.sqrt(3.0) / length
    x = rate * dt
    decay = torch.exp(-x)
    entries = (decay * (1 + x), decay * dt, -decay * rate * x, decay * (1 - x))
    variance = (sd / rate) ** 2
    cc = variance * _lower_gamma(2.0 * x)
    ce = 2.0 * variance * rate * (decay * x) ** 2
    ee = sd**2 * (-torch.expm1(-2.0 * x) + 2.0 * decay**2 * x * (1 - x))
    return entries, cc, ce, ee


def _lower_gamma(y: Tensor) -> Tensor:
    """``1 - e^-y (1 + y + y²/2)``, the variance of a Matérn process after a step in its own units; ~y³/6."""
    small = y < 2.0 * _SERIES_BELOW
    ys = torch.where(small, y, torch.zeros_like(y))
    yl = torch.where(small, torch.ones_like(y), y)
    series = torch.zeros_like(ys)
    for k in reversed(range(3, 24)):
        series = series * ys + 1.0 / math.factorial(k)
    return torch.where(small, torch.exp(-ys) * series * ys**3, 1.0 - torch.exp(-yl) * (1.0 + yl + 0.5 * yl**2))


def initial_covariance(
    coloured_sd: Float[Tensor, "*batch"], coloured_time: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 4 4"]:
    """Covariance ``(..., 4, 4)`` of ``(v, a, c, e)`` at the first row, before its measurement.

    The mean is (first measured speed, 0, 0, 0). ``v`` is nearly diffuse, so that its centre carries no information;
    ``a`` is broad, because a window may start anywhere in a drive, after unknown commands; ``c`` and ``e`` are
    stationary.
    """
    sd, length = torch.broadcast_tensors(coloured_sd, coloured_time)
    one = torch.ones_like(sd)
    coloured = (sd * length) ** 2 / 3.0
    return torch.diag_embed(torch.stack((one * SPEED_SD0**2, one * ACCEL_SD0**2, coloured, sd**2), -1))


def _tensor(value: Tensor | float, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def latent_log_likelihood(
    T_L: float | Batch,
    K_L: float | Batch,
    process_noise: float | Batch,
    coloured_sd: float | Batch,
    coloured_time: float | Batch,
    time: Signal,
    u: Signal,
    *,
    accel: Signal | None = None,
    speed: Signal | None = None,
    accel_noise: float | Batch | None = None,
    speed_noise: float | Batch | None = None,
    road_noise: float | Batch = 0.0,
    mask: Bool[Tensor, "*#batch time"] | None = None,
) -> Float[Tensor, "*batch"]:
    """Log likelihood ``(...)`` [nats] of measured acceleration and/or speed, by Kalman innovations.

    Parameters of shape ``(...)`` or broadcasting to it: ``T_L`` [s], ``K_L`` [-], ``process_noise`` [m/s²/√s],
    ``coloured_sd`` [m/s²], ``coloured_time`` [s], ``accel_noise`` [m/s²] and ``speed_noise`` [m/s] per row,
    ``road_noise`` [m/s/√s]. Data of shape ``(..., time)``: ``time`` [s] increasing, ``u`` [m/s²] held from its row to
    the next, ``accel`` [m/s²] and ``speed`` [m/s] as measured. ``mask`` ``(..., time)``: False where a row's
    measurements are not used; its command still acts. Typically parameters are ``(chain, window)`` and data
    ``(window, time)``.

    Exact for uneven rows (each interval is integrated exactly) and twice differentiable in parameters, ``u``,
    ``accel`` and ``speed``. The start is that of `initial_covariance`; the first speed's prior is centred on the first
    unmasked measured one, and the centre moves with the data: a constant added to all speeds changes nothing.

    Raises `InputError` where neither signal, or a signal without its noise, is given.
    """
    if accel is None and speed is None:
        raise InputError("accel, speed: neither was given; the latent form needs at least one measured signal")
    for name, signal, noise in (("accel", accel, accel_noise), ("speed", speed, speed_noise)):
        if signal is not None and noise is None:
            raise InputError(f"{name}_noise: missing; it is needed where {name} is measured")
    given = (T_L, K_L, process_noise, road_noise, coloured_sd, coloured_time)
    parameters = torch.broadcast_tensors(*(_tensor(p, u) for p in given))
    rows = u.shape[-1]
    used = torch.ones_like(u, dtype=torch.bool) if mask is None else mask
    covariance = initial_covariance(parameters[4], parameters[5])
    mean = torch.zeros(covariance.shape[:-1], dtype=u.dtype, device=u.device)

    # A channel: rows of data, its variance, and the row of the measurement matrix.
    channels: list[tuple[tuple[Tensor, ...], Tensor, Tensor]] = []
    if speed is not None and speed_noise is not None:
        first = used.to(torch.uint8).argmax(-1, keepdim=True)
        start = speed.gather(-1, first.expand(*speed.shape[:-1], 1)) if speed.shape[:-1] else speed[first]
        # The filter runs on the deviation from the first measured speed, whose prior mean is thereby zero.
        data = (speed - start).unbind(-1)
        channels.append((data, _tensor(speed_noise, u) ** 2, u.new_tensor(SPEED_ROW)))
    if accel is not None and accel_noise is not None:
        channels.append((accel.unbind(-1), _tensor(accel_noise, u) ** 2, u.new_tensor(ACCEL_ROW)))

    steps = discretise(*(p[..., None] for p in parameters), dt=time.diff().to(u.dtype))
    # Unbound once: the gradient of an index into a row would be as large as all rows, for every row.
    transitions, noises = steps.transition.unbind(-3), steps.noise.unbind(-3)
    pushes = (steps.gain * u[..., :-1, None]).unbind(-2)
    terms: list[Tensor] = []
    for k in range(rows):
        on = used[..., k]
        everywhere = bool(on.all())
        for data, variance, row in channels:
            innovation = data[k] - mean @ row
            if not everywhere:
                # A masked row may hold any number or NaN, and must not affect a gradient either.
                innovation = torch.where(on, innovation, 0.0)
            pointing = covariance @ row
            spread = pointing @ row + variance
            gain = pointing / spread[..., None]
            term = torch.log(spread) + innovation**2 / spread + math.log(2.0 * math.pi)
            if not everywhere:
                term, gain = torch.where(on, term, 0.0), torch.where(on[..., None], gain, 0.0)
            terms.append(term)
            mean = mean + gain * innovation[..., None]
            covariance = covariance - gain[..., :, None] * pointing[..., None, :]
        if k + 1 < rows:
            phi = transitions[k]
            mean = (phi @ mean[..., None])[..., 0] + pushes[k]
            covariance = phi @ covariance @ phi.mT + noises[k]
    return -0.5 * torch.stack(torch.broadcast_tensors(*terms)).sum(0)
