"""The transfer function from the leader's speed to the follower's, and its distance from one."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.vehicle.stability.linear_loop import Gains, LinearLoop, Value, as_tensor, linear_loop


def gain(
    omega: Value,
    T_L: Value,
    K_L: Value,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Value = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> Float[Tensor, "*setting"]:
    """`|G(j omega)|` [-] of V / V_lead, of the shape that omega [rad/s] and the setting broadcast to.

    With E = exp(-j omega theta): G = K E (k_f s^2 E_f + k_v s + k_s) / (T s^3 + s^2 + K E (-k_a s^2 + g s + k_s)).
    Formal where the loop is locally unstable; 0 where the actuation is no vehicle (T_L < 0, K_L <= 0, not finite).

    Example:
        >>> from avtorch.vehicle.stability import gain
        >>> gain([0.5, 1.0, 4.0], T_L=1.5, K_L=0.5, time_gap=1.0, gains=(1.5, 1.5, -0.8)).round(decimals=2).tolist()
        [1.21, 1.63, 0.03]
    """
    w = as_tensor(omega, [omega, T_L, K_L, time_gap, gains], "omega")
    s = linear_loop(
        T_L, K_L, time_gap, gains, dead_time=dead_time, feedforward=feedforward, feedforward_delay=feedforward_delay
    )
    size = magnitude(s, w)
    return torch.where(s.valid, size, torch.zeros_like(size))


def magnitude(s: LinearLoop, omega: Float[Tensor, "*#setting"]) -> Float[Tensor, "*setting"]:
    """`|G(j omega)|` of a setting."""
    return torch.hypot(*_numerator(s, omega)) / torch.hypot(*_denominator(s, omega))


def excess(
    s: LinearLoop, omega: Float[Tensor, "*#setting"]
) -> tuple[Float[Tensor, "*setting"], Float[Tensor, "*setting"]]:
    """(h, N) with |G|^2 = N / (N + omega^2 h): the gain is at most one exactly where h >= 0.

    Without dead time and feed-forward h = T^2 omega^4 + B omega^2 + C. Dividing by omega^2 analytically, not
    numerically, keeps the sign of h right down to omega = 0, where |G| itself rounds to one.
    """
    x = omega * omega
    k2, twice = s.K**2, 2 * s.K
    # Polynomials in x with coefficients a setting: few passes over the (setting, frequency) numbers.
    steady = torch.addcmul(
        k2 * (2 * s.ks * s.ka + s.g**2 - s.kv**2), x, torch.addcmul(1 + k2 * (s.ka**2 - s.kf**2), x, s.T**2)
    )
    real = torch.addcmul(-twice * s.ks, x, -twice * (s.ka + s.T * s.g))
    imag = omega * torch.addcmul(twice * (s.T * s.ks - s.g), x, twice * s.T * s.ka)
    turn = omega * s.theta
    h = torch.addcmul(torch.addcmul(steady, real, turn.cos()), imag, turn.sin())
    n = torch.addcmul(k2 * s.ks**2, x, k2 * s.kv**2)
    if bool((s.kf != 0).any()):
        # The leader's fed-forward acceleration adds to the numerator only.
        turn = omega * s.theta_f
        lead = 2 * k2 * s.kf * (s.ks * turn.cos() - s.kv * omega * turn.sin())
        h = h + lead
        n = n + x * (k2 * s.kf**2 * x - lead)
    return h, n


def _numerator(s: LinearLoop, w: Tensor) -> tuple[Tensor, Tensor]:
    x = w * w
    angle = w * s.theta_f
    return s.K * (s.ks - s.kf * x * torch.cos(angle)), s.K * (s.kv * w + s.kf * x * torch.sin(angle))


def _denominator(s: LinearLoop, w: Tensor) -> tuple[Tensor, Tensor]:
    x = w * w
    c, d = torch.cos(w * s.theta), torch.sin(w * s.theta)
    qr, qi = s.ks + s.ka * x, s.g * w
    return s.K * (qr * c + qi * d) - x, s.K * (qi * c - qr * d) - s.T * w * x
