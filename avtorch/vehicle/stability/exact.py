"""The exact string condition without dead time, in closed form: B, C and the peak of |G|."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.vehicle.arguments import broadcast
from avtorch.vehicle.stability.linear_loop import Gains, LinearLoop, Value, linear_loop

# Rounding must not make a loop on the boundary (C = 0 on paper) unstable: the sums below have some ten roundings.
ROUNDINGS = 16


def string_margins(
    T_L: Value, K_L: Value, time_gap: Value, gains: Gains, *, feedforward: Value = 0.0
) -> tuple[Float[Tensor, "*setting"], Float[Tensor, "*setting"]]:
    """(B, C) of the exact string condition: `|G|^2` <= 1 at omega iff `T^2 omega^4 + B omega^2 + C >= 0`.

    B = (1 - K k_a)^2 - 2 T K g [-] is Eq. 3's first line at one point, C / K [1/s^2] its last. With a feed-forward gain
    (no communication delay) B loses K^2 k_f^2 and C gains 2 K^2 k_s k_f. -inf where the actuation is no vehicle.
    """
    s = linear_loop(T_L, K_L, time_gap, gains, feedforward=feedforward)
    B, C = broadcast(*coefficients(s))
    low = torch.full_like(B, -torch.inf)
    return s.full(torch.where(s.valid, B, low)), s.full(torch.where(s.valid, C, low))


def coefficients(s: LinearLoop) -> tuple[Float[Tensor, "*setting"], Float[Tensor, "*setting"]]:
    """(B, C), the dead time and the feed-forward's delay ignored."""
    B = s.b**2 - 2 * s.T * s.K * s.g - (s.K * s.kf) ** 2
    C = s.K**2 * (s.g**2 - s.kv**2 + 2 * s.ks * s.kf) - 2 * s.K * s.ks * s.b
    return B, C


def gain_condition(s: LinearLoop) -> Bool[Tensor, "*setting"]:
    """`|G| <= 1` at every omega, without dead time: C >= 0 and (B >= 0 or B^2 <= 4 T^2 C), to rounding."""
    B, C = coefficients(s)
    eps = ROUNDINGS * torch.finfo(C.dtype).eps
    slack = eps * (
        s.K**2 * (s.g**2 + s.kv**2 + 2 * (s.ks * s.kf).abs()) + 2 * s.K * s.ks.abs() * (1 + (s.K * s.ka).abs())
    )
    B_slack = eps * ((1 + (s.K * s.ka).abs()) ** 2 + 2 * s.T * s.K * s.g.abs() + (s.K * s.kf) ** 2)
    room = 4 * s.T**2 * (C + slack) + 2 * B.abs() * B_slack - B**2
    return (C + slack >= 0) & ((B + B_slack >= 0) | (room >= 0))


def peak_omega(s: LinearLoop) -> Float[Tensor, "*setting"]:
    """Frequency [rad/s] at which |G| is largest, 0 where |G| nowhere exceeds one; no dead time, no feed-forward.

    With x = omega^2, |G|^2 = N / (N + P), N = K^2 (k_v^2 x + k_s^2), P = T^2 x^3 + B x^2 + C x. P / N is stationary at
    the roots of a cubic; by the signs of its coefficients the only minimum below zero is its largest root. Newton from
    a bound above that root falls on it monotonically (the cubic is convex there). Where no such root exists the
    iteration may end anywhere; |G| there is below one, so the result is unaffected.
    """
    B, C = coefficients(s)
    n0, n1, T2 = s.ks**2, s.kv**2, s.T**2
    c3, c2, c1, c0 = broadcast(2 * n1 * T2, 3 * T2 * n0 + B * n1, 2 * B * n0, C * n0)
    x = _above_roots(c3, c2, c1, c0)
    for _ in range(24):
        f, df = ((c3 * x + c2) * x + c1) * x + c0, (3 * c3 * x + 2 * c2) * x + c1
        x = torch.where(df > 0, x - f / torch.where(df > 0, df, torch.ones_like(df)), x).clamp_min(0)
    above = (T2 * x + B) * x + C < 0
    return torch.where(above, x, torch.zeros_like(x)).sqrt()


def _above_roots(
    c3: Float[Tensor, "*setting"],
    c2: Float[Tensor, "*setting"],
    c1: Float[Tensor, "*setting"],
    c0: Float[Tensor, "*setting"],
) -> Float[Tensor, "*setting"]:
    """A number at or above every positive root, where some leading coefficient is positive.

    A third of one positive term of higher degree, the one that gives the smallest bound, outweighs each negative term.
    """
    bound = torch.zeros_like(c0)
    rest = (c0, c1, c2, c3)
    for low in range(3):
        cheapest = torch.full_like(c0, torch.inf)
        for high in range(low + 1, 4):
            usable = rest[high] > 0
            ratio = 3 * (-rest[low]).clamp_min(0) / torch.where(usable, rest[high], torch.ones_like(c0))
            reach = torch.where(usable, ratio ** (1 / (high - low)), torch.full_like(c0, torch.inf))
            cheapest = torch.minimum(cheapest, reach)
        bound = torch.maximum(bound, torch.where(rest[low] < 0, cheapest, torch.zeros_like(c0)))
    return torch.where(torch.isfinite(bound), bound, torch.ones_like(bound))
