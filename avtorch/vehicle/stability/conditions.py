"""Eq. 2 (local) and Eq. 3 (string, sufficient), for a point or a box of (T_L, K_L): as printed, and rigorous."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import broadcast
from avtorch.vehicle.stability.linear_loop import Gains, LinearLoop, Value, linear_loop

Form = Literal["rigorous", "print"]
PointOrBox = Value | tuple[Value, Value]


@dataclass(frozen=True)
class Conditions:
    """The left-minus-right sides of a set of inequalities: each must be > 0.

    names: one label a condition. values: (..., condition), -inf where the actuation is no vehicle.
    """

    names: tuple[str, ...]
    values: Float[Tensor, "*setting condition"]

    @property
    def holds(self) -> Bool[Tensor, "*setting"]:
        """True where every condition holds, shape (...)."""
        return (self.values > 0).all(-1)


def local_conditions(
    T_L: PointOrBox, K_L: PointOrBox, time_gap: Value, gains: Gains, *, form: Form = "rigorous"
) -> Conditions:
    """Eq. 2 over the box T_L x K_L; a (lower, upper) tuple gives bounds, a number or tensor one point.

    form="print" pairs T^l with K^u in its last line and so passes some boxes that hold an unstable vehicle.
    form="rigorous" pairs T^u with both ends of K: times K the condition is linear in T_L and in K_L, so with k_s > 0
    it holds all over the box iff it holds there. On one point the two forms are the same and exact (Routh-Hurwitz).

    Raises InputError for an unknown form and for bounds that are not 0 <= T^l <= T^u and 0 < K^l <= K^u.
    """
    low, high = _corners(T_L, K_L, time_gap, gains, form)
    s = high
    T_last = low.T if form == "print" else high.T
    name = "T^l" if form == "print" else "T^u"
    rows = {
        "1 - K^u k_a": 1 - high.K * s.ka,
        "k_s tau + k_v": s.g,
        "k_s": s.ks,
        "(1/K^l - k_a) g - T^u k_s / K^l": (1 / low.K - s.ka) * s.g - high.T * s.ks / low.K,
        f"(1/K^u - k_a) g - {name} k_s / K^u": (1 / high.K - s.ka) * s.g - T_last * s.ks / high.K,
    }
    return _stack(rows, low, high)


def string_conditions(
    T_L: PointOrBox, K_L: PointOrBox, time_gap: Value, gains: Gains, *, form: Form = "rigorous"
) -> Conditions:
    """Eq. 3 over the box T_L x K_L (arguments as in `local_conditions`): sufficient for `|G| <= 1`, not necessary.

    form="print": the three printed lines, K^u in the last term of both squares. form="rigorous": the least value over
    the box of B = (1 - K k_a)^2 - 2 T K g, linear in T_L and a convex quadratic in K_L whose vertex may lie inside, and
    of C / K, linear in K_L. Neither form implies local stability: see `string_sufficient`.
    """
    low, high = _corners(T_L, K_L, time_gap, gains, form)
    s = high
    slope = 2 * s.ks * s.ka + s.g**2 - s.kv**2
    if form == "print":
        lag = 2 * high.T * high.K * s.g
        rows = {
            "(K^u k_a - 1)^2 - 2 T^u K^u g": (high.K * s.ka - 1) ** 2 - lag,
            "(K^l k_a - 1)^2 - 2 T^u K^u g": (low.K * s.ka - 1) ** 2 - lag,
            "K^l (2 k_s k_a + g^2 - k_v^2) - 2 k_s": low.K * slope - 2 * s.ks,
        }
        return _stack(rows, low, high)
    lowest_B = torch.minimum(_least_B(low.T, low, high), _least_B(high.T, low, high))
    rows = {
        "min (1 - K k_a)^2 - 2 T K g": lowest_B,
        "min K (2 k_s k_a + g^2 - k_v^2) - 2 k_s": torch.minimum(low.K * slope, high.K * slope) - 2 * s.ks,
    }
    return _stack(rows, low, high)


def string_sufficient(
    T_L: PointOrBox, K_L: PointOrBox, time_gap: Value, gains: Gains, *, form: Form = "rigorous"
) -> Bool[Tensor, "*setting"]:
    """True where Eq. 3 holds over the point or box, shape (...).

    form="rigorous" requires Eq. 2 as well, because the gain condition alone also passes locally unstable loops; so
    every vehicle of a box that passes is string stable. form="print" is Eq. 3 as printed, without Eq. 2.

    Example:
        >>> from avtorch.vehicle.stability import string_stable, string_sufficient
        >>> at = dict(T_L=1.5, K_L=0.5, time_gap=2.5, gains=(1.5, 1.5, -0.8))
        >>> string_sufficient(**at).item(), string_stable(**at).item()  # sufficient, not necessary
        (False, True)
    """
    string = string_conditions(T_L, K_L, time_gap, gains, form=form).holds
    if form == "print":
        return string
    return string & local_conditions(T_L, K_L, time_gap, gains, form=form).holds


def _least_B(T: Tensor, low: LinearLoop, high: LinearLoop) -> Tensor:
    """Least B over K in [K^l, K^u] at one T: at the vertex (k_a + T g) / k_a^2 if inside, else at an end."""
    ka2 = low.ka**2
    vertex = torch.where(ka2 > 0, (low.ka + T * low.g) / torch.where(ka2 > 0, ka2, torch.ones_like(ka2)), low.K)
    K = torch.minimum(torch.maximum(vertex, low.K), high.K)
    ends = torch.minimum(_B(T, low.K, low), _B(T, high.K, low))
    return torch.minimum(ends, _B(T, K, low))


def _B(T: Tensor, K: Tensor, s: LinearLoop) -> Tensor:
    return (1 - K * s.ka) ** 2 - 2 * T * K * s.g


def _corners(T_L: PointOrBox, K_L: PointOrBox, tau: Value, gains: Gains, form: str) -> tuple[LinearLoop, LinearLoop]:
    if form not in ("rigorous", "print"):
        raise InputError(f"form: expected 'rigorous' or 'print', found {form!r}")
    T_low, T_high = _bounds(T_L, "T_L")
    K_low, K_high = _bounds(K_L, "K_L")
    low, high = linear_loop(T_low, K_low, tau, gains), linear_loop(T_high, K_high, tau, gains)
    if isinstance(T_L, tuple) and not bool((low.T <= high.T).all() & (torch.as_tensor(T_low) >= 0).all()):
        raise InputError("T_L: expected bounds 0 <= lower <= upper [s]")
    if isinstance(K_L, tuple) and not bool((low.K <= high.K).all() & (torch.as_tensor(K_low) > 0).all()):
        raise InputError("K_L: expected bounds 0 < lower <= upper")
    return low, high


def _bounds(value: PointOrBox, name: str) -> tuple[Value, Value]:
    if not isinstance(value, tuple):
        return value, value
    if len(value) != 2:
        raise InputError(f"{name}: expected a (lower, upper) pair, found {len(value)} values")
    return value


def _stack(rows: dict[str, Tensor], low: LinearLoop, high: LinearLoop) -> Conditions:
    values = torch.stack(broadcast(*rows.values()), -1)
    valid = (low.valid & high.valid).unsqueeze(-1)
    return Conditions(tuple(rows), torch.where(valid, values, torch.full_like(values, -torch.inf)))
