"""Is a setting locally stable and string stable, and what is its peak gain? With and without dead time."""

from __future__ import annotations

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.vehicle.stability.exact import gain_condition, peak_omega
from avtorch.vehicle.stability.linear_loop import Gains, LinearLoop, Value, linear_loop
from avtorch.vehicle.stability.nyquist import hurwitz, lost_at, nyquist
from avtorch.vehicle.stability.sweep import exceeds_anywhere, sweep
from avtorch.vehicle.stability.transfer import magnitude


def local_stable(
    T_L: Value, K_L: Value, time_gap: Value, gains: Gains, *, dead_time: Value = 0.0
) -> Bool[Tensor, "*setting"]:
    """True where disturbances die out: Eq. 2 at one point, or a Nyquist count where dead_time [s] > 0.

    T_L [s], K_L [-], time_gap [s] and dead_time broadcast with the leading dimensions of gains (..., 3) =
    (k_s [1/s^2], k_v [1/s], k_a [-]); returns bool of that shape. Exact both ways. Feed-forward
    does not enter. T_L < 0, K_L <= 0, infinite or NaN (a lower level that inverts itself unstable) is not stable.
    """
    s = linear_loop(T_L, K_L, time_gap, gains, dead_time=dead_time)
    return s.full(locally_stable(s))


def string_stable(
    T_L: Value,
    K_L: Value,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Value = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> Bool[Tensor, "*setting"]:
    """True where the loop is locally stable and `|G(j omega)| <= 1` at every omega; arguments as in `local_stable`.

    Without dead time in closed form (the signs of B and C); with dead time, or with a feed-forward gain k_f [-] on the
    leader's acceleration that is itself delayed [s], by frequency sweep. The only tolerance is rounding: a few tens of
    machine epsilons of the terms summed, so a loop exactly on the boundary counts as stable.

    Example:
        >>> from avtorch.vehicle.stability import string_stable
        >>> string_stable(T_L=1.5, K_L=0.5, time_gap=[1.0, 2.0, 2.5], gains=(1.5, 1.5, -0.8)).tolist()
        [False, False, True]
    """
    s = linear_loop(
        T_L, K_L, time_gap, gains, dead_time=dead_time, feedforward=feedforward, feedforward_delay=feedforward_delay
    )
    return s.full(string_stable_of(s))


def peak_gain(
    T_L: Value,
    K_L: Value,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Value = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> Float[Tensor, "*setting"]:
    """Supremum of `|G(j omega)|` over omega > 0 [-].

    1 where string stable (G -> 1 as omega -> 0), inf where locally unstable.
    Arguments as in `string_stable`. Without dead time the peak's frequency is the root of a cubic, else it is swept and
    refined. Differentiable once in every argument where finite: the peak moves, but at a maximum that is of second
    order, so the derivative is that of `|G|` at the peak's frequency (0 where string stable).

    Example:
        >>> import torch
        >>> from avtorch.vehicle.stability import peak_gain
        >>> round(float(peak_gain(T_L=0.3, K_L=1.0, time_gap=1.0, gains=(1.5, 1.5, -0.8), dead_time=0.4)), 4)
        1.7464
        >>> T_L = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
        >>> peak_gain(T_L, 0.5, 1.0, (1.5, 1.5, -0.8)).backward()
        >>> round(float(T_L.grad), 3)  # per second of lag
        2.446
    """
    s = linear_loop(
        T_L, K_L, time_gap, gains, dead_time=dead_time, feedforward=feedforward, feedforward_delay=feedforward_delay
    )
    return peak_gain_of(s)


def peak_frequency(
    T_L: Value,
    K_L: Value,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Value = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> Float[Tensor, "*setting"]:
    """Frequency [rad/s] of the largest `|G(j omega)|`; 0 where string stable, for the supremum then lies at omega -> 0.

    Arguments as in `string_stable`. Where the loop is locally unstable it is the largest formal `|G|` on the axis (near
    the growing oscillation, if barely unstable); 0 where the actuation is no vehicle. Carries no gradient.

    Example:
        >>> from avtorch.vehicle.stability import peak_frequency
        >>> round(float(peak_frequency(T_L=0.3, K_L=1.0, time_gap=1.0, gains=(1.5, 1.5, -0.8), dead_time=0.4)), 2)
        3.02
    """
    s = linear_loop(
        T_L, K_L, time_gap, gains, dead_time=dead_time, feedforward=feedforward, feedforward_delay=feedforward_delay
    )
    with torch.no_grad():
        return _peak_frequency(s, s.full(s.valid & (s.ks > 0)))


def dead_time_margin(T_L: Value, K_L: Value, time_gap: Value, gains: Gains) -> Float[Tensor, "*setting"]:
    """Smallest dead time [s] at which the loop loses its local stability, in closed form; 0 where it has none.

    Example:
        >>> from avtorch.vehicle.stability import dead_time_margin
        >>> round(float(dead_time_margin(T_L=0.3, K_L=1.0, time_gap=1.0, gains=(1.5, 1.5, -0.8))), 3)
        0.521
    """
    s = linear_loop(T_L, K_L, time_gap, gains)
    return s.full(lost_at(s))


def locally_stable(s: LinearLoop) -> Bool[Tensor, "..."]:
    """`local_stable` of a setting, in the smallest shape that suffices."""
    if not bool((s.theta > 0).any()):
        return hurwitz(s)
    return torch.where(s.theta > 0, nyquist(s), hurwitz(s))


def string_stable_of(s: LinearLoop) -> Bool[Tensor, "..."]:
    """`string_stable` of a setting, likewise."""
    with torch.no_grad():
        delayed = (s.theta > 0) | ((s.kf != 0) & (s.theta_f > 0))
        if not bool(delayed.any()):
            return hurwitz(s) & gain_condition(s)
        stable = s.full(locally_stable(s))
        # C is the same with a dead time and must not be negative: settings that fail need no sweep.
        flat = s.full(gain_condition(s))
        verdict = stable & torch.where(s.full(delayed), _level(s), flat)
        todo = verdict & s.full(delayed)
        if bool(todo.any()):
            verdict = verdict.masked_scatter(todo, ~exceeds_anywhere(s.map(torch.detach).pick(todo)))
        return verdict


def peak_gain_of(s: LinearLoop) -> Float[Tensor, "*setting"]:
    """`peak_gain` of a setting, in its full shape."""
    with torch.no_grad():
        stable = s.full(locally_stable(s))
        omega = _peak_frequency(s, stable)
    size = magnitude(s, torch.where(omega > 0, omega, torch.ones_like(omega)))
    size = torch.where((omega > 0) & stable, size, torch.ones_like(size)).clamp_min(1)
    return torch.where(stable, size, torch.full_like(size, torch.inf))


def _level(s: LinearLoop) -> Tensor:
    """C >= -slack, a generous bound: the sweep decides the rest."""
    C = s.K**2 * (s.g**2 - s.kv**2 + 2 * s.ks * s.kf) - 2 * s.K * s.ks * s.b
    return s.full(C + 1e-9 * (1 + C.abs()) >= 0)


def _peak_frequency(s: LinearLoop, wanted: Bool[Tensor, "*setting"]) -> Float[Tensor, "*setting"]:
    """Peak frequency of the full shape where `wanted`, else 0."""
    s = s.map(torch.detach)
    swept = s.full((s.theta > 0) | (s.kf != 0))
    omega = torch.where(wanted & ~swept, peak_omega(s), torch.zeros((), dtype=s.T.dtype, device=s.T.device))
    todo = wanted & swept
    if bool(todo.any()):
        found, _ = sweep(s.pick(todo))
        omega = omega.masked_scatter(todo, found)
    return omega
