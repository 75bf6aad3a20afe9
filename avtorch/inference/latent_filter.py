"""Exact log likelihood of the latent form by a Kalman filter, row by row: any sampling, gaps, masked rows.

The slow and general method; `latent_steady` is the fast one for even sampling, with the same result.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.inference.latent_model import ACCEL_ROW, SPEED_ROW, discretise, initial_covariance


def _tensor(value: Tensor | float, like: Tensor) -> Tensor:
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def latent_log_likelihood(
    T_L: float | Float[Tensor, "*#batch"],
    K_L: float | Float[Tensor, "*#batch"],
    process_noise: float | Float[Tensor, "*#batch"],
    coloured_sd: float | Float[Tensor, "*#batch"],
    coloured_time: float | Float[Tensor, "*#batch"],
    time: Float[Tensor, "*#batch time"],
    u: Float[Tensor, "*#batch time"],
    *,
    accel: Float[Tensor, "*#batch time"] | None = None,
    speed: Float[Tensor, "*#batch time"] | None = None,
    accel_noise: float | Float[Tensor, "*#batch"] | None = None,
    speed_noise: float | Float[Tensor, "*#batch"] | None = None,
    road_noise: float | Float[Tensor, "*#batch"] = 0.0,
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

    Raises `InputError` where neither signal, or a signal without its
    noise, is given.
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
