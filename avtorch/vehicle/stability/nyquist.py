"""Local stability: Routh-Hurwitz without dead time, an exact Nyquist count with it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.vehicle.arguments import broadcast
from avtorch.vehicle.stability.linear_loop import LinearLoop


def hurwitz(s: LinearLoop) -> Bool[Tensor, "..."]:
    """Eq. 2 at one point (Routh-Hurwitz, the dead time ignored): all roots of the cubic in the open left half plane."""
    return s.valid & (s.b > 0) & (s.g > 0) & (s.ks > 0) & (s.b * s.g > s.T * s.ks)


def crossings(
    s: LinearLoop,
) -> tuple[Float[Tensor, "*setting 3"], Float[Tensor, "*setting 3"], Float[Tensor, "*setting 3"]]:
    """Where the open loop L = K q / p, p = s^2 (T s + 1), q = -k_a s^2 + g s + k_s, has |L(j omega)| = 1.

    Returns (omega, phase, sign), each (..., 3): the frequency [rad/s]; the phase lag in [0, 2 pi) that turns L onto -1
    there; and +1 where |L| falls through one (more lag then pushes a pair of roots to the right), -1 where it rises,
    0 for no crossing. A dead time only turns L, so these hold for every theta: |p|^2 = K^2 |q|^2 is a cubic in omega^2.
    Needs k_s != 0.
    """
    k2 = (s.K * s.ks) ** 2
    k2 = torch.where(k2 > 0, k2, torch.ones_like(k2))
    # In z = 1 / omega^2 the leading coefficient never vanishes, however small T is.
    c2 = s.K**2 * (2 * s.ks * s.ka + s.g**2) / k2
    c1 = ((s.K * s.ka) ** 2 - 1) / k2
    c0 = -(s.T**2) / k2
    z = _real_roots(*broadcast(c2, c1, c0))
    c2, c1, c0 = (c.unsqueeze(-1) for c in (c2, c1, c0))
    slope = (3 * z + 2 * c2) * z + c1
    # Without lag one root is z = 0 (omega infinite), which is not a crossing; rounding must not make it one.
    floor = torch.where(s.T.unsqueeze(-1) == 0, 1e-10 * (c2.abs() + c1.abs().sqrt()), torch.zeros_like(c2))
    real = torch.isfinite(z) & (z > floor.clamp_min(torch.finfo(z.dtype).tiny))
    omega = torch.where(real, z, torch.ones_like(z)).rsqrt()
    t = s.column()
    phase = torch.atan2(t.g * omega, t.ks + t.ka * omega**2) - torch.atan(t.T * omega)
    phase = torch.remainder(phase, 2 * math.pi)
    return omega, phase, torch.where(real, torch.sign(slope), torch.zeros_like(slope))


def nyquist(s: LinearLoop) -> Bool[Tensor, "..."]:
    """Locally stable with the dead time: no root of T s^3 + s^2 + K exp(-theta s) q(s) with Re s >= 0, shape (...).

    The roots on the right are counted, not sampled: those of the delay-free loop (Routh-Hurwitz: none, or two when
    k_s > 0), plus two each time the dead time has turned a crossing of the unit circle past -1 in the bad direction,
    minus two in the good one. k_s <= 0 leaves a real root at or above zero in every case.
    """
    omega, phase, sign = crossings(s)
    rotation = omega * s.theta.unsqueeze(-1)
    passed = torch.floor((rotation - phase) / (2 * math.pi)) + 1
    right = torch.where(hurwitz(s), 0, 2) + 2 * (sign * passed.clamp_min(0)).sum(-1)
    # Without lag the loop is of neutral type: |K k_a| >= 1 then feeds the delay back undamped.
    neutral = (s.T > 0) | (s.theta == 0) | ((s.K * s.ka).abs() < 1)
    return s.valid & (s.ks > 0) & neutral & (right == 0)


def lost_at(s: LinearLoop) -> Float[Tensor, "*setting"]:
    """Smallest dead time [s] at which a loop loses its local stability; 0 where it is unstable without dead time."""
    omega, phase, sign = crossings(s)
    first = torch.where(sign > 0, phase / omega, torch.full_like(phase, torch.inf)).amin(-1)
    neutral = (s.T == 0) & ((s.K * s.ka).abs() >= 1)
    return torch.where(hurwitz(s) & ~neutral, first, torch.zeros_like(first))


def _real_roots(
    c2: Float[Tensor, "*setting"], c1: Float[Tensor, "*setting"], c0: Float[Tensor, "*setting"]
) -> Float[Tensor, "*setting 3"]:
    """Real roots of z^3 + c2 z^2 + c1 z + c0, (..., 3), NaN in the places of complex ones (trigonometric form)."""
    shift = c2 / 3
    p = c1 - c2 * shift
    q = 2 * shift**3 - shift * c1 + c0
    # Three real roots: p < 0 and 4 p^3 + 27 q^2 <= 0.
    r = torch.sqrt(torch.clamp(-p / 3, min=0))
    r3 = torch.where(r > 0, r, torch.ones_like(r)) ** 3
    cosine = torch.where(r > 0, -q / (2 * r3), torch.full_like(q, torch.inf))
    angle = torch.acos(cosine.clamp(-1, 1)) / 3
    turns = torch.tensor([0.0, 2.0, 4.0], dtype=c2.dtype, device=c2.device) * (math.pi / 3)
    three = 2 * r.unsqueeze(-1) * torch.cos(angle.unsqueeze(-1) - turns)
    # One real root, in the form without cancellation.
    half = torch.sqrt(torch.clamp(q**2 / 4 + p**3 / 27, min=0))
    side = -q / 2 + torch.where(q > 0, -half, half)
    u = torch.sign(side) * side.abs() ** (1 / 3)
    one = u - torch.where(u != 0, p / (3 * torch.where(u != 0, u, torch.ones_like(u))), torch.zeros_like(u))
    nothing = torch.full_like(one, torch.nan)
    single = torch.stack((one, nothing, nothing), -1)
    z = torch.where((cosine.abs() <= 1).unsqueeze(-1), three, single) - shift.unsqueeze(-1)
    c2, c1, c0 = (c.unsqueeze(-1) for c in (c2, c1, c0))
    for _ in range(3):
        # Newton removes the rounding of the shift back; points of zero slope are left alone.
        f, df = ((z + c2) * z + c1) * z + c0, (3 * z + 2 * c2) * z + c1
        z = torch.where(df != 0, z - f / torch.where(df != 0, df, torch.ones_like(df)), z)
    return z
