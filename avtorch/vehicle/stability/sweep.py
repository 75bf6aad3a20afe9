"""Peak gain where no closed form exists (dead time, feed-forward): a frequency sweep with refinement."""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.vehicle.stability.exact import ROUNDINGS
from avtorch.vehicle.stability.linear_loop import LinearLoop
from avtorch.vehicle.stability.transfer import excess

DECADES = 3.5  # below this the sweep is one bracket, down to omega = 0
POINTS = 320  # 2.5 % apart: the sweep detects the flanks of a resonance of any sharpness
MOST_POINTS = 8192
FEW_POINTS = 80  # for a verdict that is not close
BLOCK = 1 << 17  # numbers evaluated at a time: the temporaries stay in the cache
GOLDEN = (math.sqrt(5) - 1) / 2


def sweep(s: LinearLoop) -> tuple[Float[Tensor, " setting"], Bool[Tensor, " setting"]]:
    """(omega, above) of a flat batch (setting,): the frequency of the largest |G| [rad/s] and whether |G| > 1 there.

    omega is 0 where |G| nowhere exceeds one. The sweep minimises omega^2 h / N = |G|^-2 - 1, which keeps its sign near
    omega = 0. The best two dips of the sweep are refined by golden section. Needs valid entries.
    """
    count = s.T.shape[0]
    if count == 0:
        return s.T.new_zeros(0), torch.zeros(0, dtype=torch.bool, device=s.T.device)
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    top = _band(s)
    points = _points(s, top)
    # Settings whose delay turns many times in the band need a finer sweep: they are swept separately, to spare the
    # others. torch gives `unique` no type
    sizes = cast(Tensor, torch.unique(points))  # pyright: ignore[reportUnknownMemberType]
    for n in map(int, sizes):
        rows = torch.nonzero(points == n).squeeze(-1)
        for chunk in torch.split(rows, max(1, BLOCK // n)):
            parts.append((chunk, *_sweep(s.map(lambda x, rows=chunk: x[rows]), top[chunk], n)))
    order = torch.cat([p[0] for p in parts]).argsort()
    return torch.cat([p[1] for p in parts])[order], torch.cat([p[2] for p in parts])[order]


def exceeds_anywhere(s: LinearLoop) -> Bool[Tensor, " setting"]:
    """Whether |G| > 1 at any frequency, for a flat batch (setting,); as `sweep`, but decided on few points if possible.

    In ln(omega) no term of h bends more than (4 + omega theta)^2 times its own size, so between points `step` apart h
    lies at most (step (4 + omega theta))^2 / 8 of that size below its neighbours. One point below zero decides it; all
    points above that bound decide it too; only the remaining settings need the full sweep.
    """
    above = torch.zeros(s.T.shape, dtype=torch.bool, device=s.T.device)
    grid = torch.logspace(-DECADES, 0, FEW_POINTS, dtype=s.T.dtype, device=s.T.device)
    step = DECADES * math.log(10) / (FEW_POINTS - 1)
    unsure: list[Tensor] = []
    for rows in torch.split(torch.arange(s.T.shape[0], device=s.T.device), max(1, BLOCK // FEW_POINTS)):
        col = s.map(lambda x, rows=rows: x[rows].unsqueeze(-1))
        omega = _band(col) * grid
        h, size = excess(col, omega)[0], _size(col, omega)
        bend = (step * (4 + omega * torch.maximum(col.theta, col.theta_f))) ** 2 / 8
        above[rows] = (h < -_rounding(size)).any(-1)
        # The factor covers the growth of `size` itself across one step.
        clear = (h > math.exp(4 * step) * bend * size).all(-1)
        unsure.append(rows[~clear & ~above[rows]])
    rest = torch.cat(unsure) if unsure else torch.zeros(0, dtype=torch.long, device=s.T.device)
    if rest.numel():
        above[rest] = sweep(s.map(lambda x: x[rest]))[1]
    return above


def _sweep(
    s: LinearLoop, top: Float[Tensor, " setting"], points: int
) -> tuple[Float[Tensor, " setting"], Bool[Tensor, " setting"]]:
    col = s.column()
    grid = torch.logspace(-DECADES, 0, points, dtype=top.dtype, device=top.device)
    omega = top.unsqueeze(-1) * grid
    value = _shortfall(col, omega)
    edge = value.new_full((value.shape[0], 1), torch.inf)
    dip = (value <= torch.cat((edge, value[:, :-1]), -1)) & (value <= torch.cat((value[:, 1:], edge), -1))
    place = torch.where(dip, value, torch.full_like(value, torch.inf)).topk(min(2, points), -1, largest=False).indices
    a = torch.where(place > 0, omega.gather(-1, (place - 1).clamp_min(0)), torch.zeros_like(place, dtype=top.dtype))
    d = omega.gather(-1, (place + 1).clamp_max(points - 1))
    best = _golden(col, a, d)
    value = _shortfall(col, best)
    pick = value.argmin(-1, keepdim=True)
    best = best.gather(-1, pick).squeeze(-1)
    above = _exceeds(s, best)
    # A dip that starts at omega = 0 may be shallower than the refinement: there h(0) = C decides.
    low = _exceeds(s, torch.zeros_like(best))
    return torch.where(above, best, torch.zeros_like(best)), above | low


def _golden(
    col: LinearLoop, a: Float[Tensor, "setting dip"], d: Float[Tensor, "setting dip"]
) -> Float[Tensor, "setting dip"]:
    """Minimum of the shortfall between a and d, (setting, dip), to about 1e-8 of the bracket."""
    b, c = d - GOLDEN * (d - a), a + GOLDEN * (d - a)
    fb, fc = _shortfall(col, b), _shortfall(col, c)
    for _ in range(38):
        left = fb < fc
        a, d = torch.where(left, a, b), torch.where(left, c, d)
        fresh = torch.where(left, d - GOLDEN * (d - a), a + GOLDEN * (d - a))
        f = _shortfall(col, fresh)
        b, c = torch.where(left, fresh, c), torch.where(left, b, fresh)
        fb, fc = torch.where(left, f, fc), torch.where(left, fb, f)
    return (a + d) / 2


def _shortfall(s: LinearLoop, omega: Tensor) -> Tensor:
    """|G|^-2 - 1."""
    h, n = excess(s, omega)
    return omega * omega * h / n.clamp_min(torch.finfo(n.dtype).tiny)


def _exceeds(s: LinearLoop, omega: Tensor) -> Tensor:
    """h < 0 by more than rounding."""
    return excess(s, omega)[0] < -_rounding(_size(s, omega))


def _rounding(size: Tensor) -> Tensor:
    return 2 * ROUNDINGS * torch.finfo(size.dtype).eps * size


def _size(s: LinearLoop, omega: Tensor) -> Tensor:
    """Sum of the absolute terms of h, the scale of its rounding and its curvature."""
    x = omega * omega
    k2, twice = s.K**2, 2 * s.K
    ks, kv, ka, kf, g = s.ks.abs(), s.kv.abs(), s.ka.abs(), s.kf.abs(), s.g.abs()
    c0 = k2 * (2 * ks * ka + g**2 + kv**2 + 2 * kf * ks) + twice * ks
    c1 = twice * (s.T * ks + g) + 2 * k2 * kf * kv
    c2 = 1 + k2 * (ka**2 + kf**2) + twice * (ka + s.T * g)
    even = torch.addcmul(c0, x, torch.addcmul(c2, x, s.T**2))
    return torch.addcmul(even, omega, torch.addcmul(c1, x, twice * s.T * ka))


def _band(s: LinearLoop) -> Tensor:
    """Frequency [rad/s] above which |G| < 1 for sure: |p| outgrows K (|q| + |numerator|), with Fujiwara's bound."""
    a = s.K * (s.ka.abs() + s.kf.abs())
    b = s.K * (s.g.abs() + s.kv.abs())
    c = 2 * s.K * s.ks.abs()
    T = torch.where(s.T > 0, s.T, torch.ones_like(s.T))
    # |p| >= T omega^3 always, and |p| >= omega^2, which helps where T is small and a < 1.
    cubic = 2 * torch.maximum(torch.maximum(a / T, (b / T).sqrt()), (c / T) ** (1 / 3))
    cubic = torch.where(s.T > 0, cubic, torch.full_like(cubic, torch.inf))
    lead = torch.where(a < 1, 1 - a, torch.ones_like(a))
    square = torch.where(a < 1, 2 * torch.maximum(b / lead, (c / lead).sqrt()), torch.full_like(a, torch.inf))
    top = torch.minimum(cubic, square)
    return torch.where(torch.isfinite(top) & (top > 0), top, torch.full_like(top, 1e3))


def _points(s: LinearLoop, top: Tensor) -> Tensor:
    """Points of the sweep, a power of two times POINTS: steps of at most a quarter radian of delay at the top."""
    turn = top * torch.maximum(s.theta, s.theta_f) * (DECADES * math.log(10)) / (0.25 * POINTS)
    doubled = torch.ceil(torch.log2(turn.clamp_min(1)))
    return (POINTS * 2**doubled).clamp_max(MOST_POINTS).long()
