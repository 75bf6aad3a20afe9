"""Stability over a plane: any two of (k_s, k_v, k_a, tau, T, K), the rest held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float
from avtorch.errors import InputError
from avtorch.vehicle.stability.conditions import PointOrBox, local_conditions, string_sufficient
from avtorch.vehicle.stability.linear_loop import Gains, Value
from avtorch.vehicle.stability.local_and_string import local_stable, peak_gain, string_stable

AXES = ("k_s", "k_v", "k_a", "tau", "T", "K")
Axis = tuple[str, Sequence[float] | Tensor]


@dataclass(frozen=True)
class Region:
    """Masks over a plane, each (y, x).

    local: locally stable. string: string stable (form "exact"), or what Eq. 3's box form passes. peak_gain: inf where
    locally unstable; None for the box forms, which are about every vehicle of a box at once.
    """

    x_name: str
    x: Float[Tensor, " x"]
    y_name: str
    y: Float[Tensor, " y"]
    form: str
    local: Bool[Tensor, "y x"]
    string: Bool[Tensor, "y x"]
    peak_gain: Float[Tensor, "y x"] | None

    @property
    def string_share(self) -> float:
        """Share of the plane's points that is string stable."""
        return float(self.string.double().mean())


def region(
    x: Axis,
    y: Axis,
    *,
    T_L: PointOrBox = 0.3,
    K_L: PointOrBox = 1.0,
    time_gap: Value = 1.0,
    gains: Gains = (1.5, 1.5, -0.8),
    dead_time: float = 0.0,
    form: Literal["exact", "print", "rigorous"] = "exact",
) -> Region:
    """Stability over the plane of two axes, each (name, values) with a name out of k_s, k_v, k_a, tau, T, K.

    Parameters that no axis names keep the value given. form="exact" checks points, with any dead_time [s]; "print" and
    "rigorous" check boxes by Eqs. 2 and 3 (`local_conditions`, `string_sufficient`), where T_L and K_L may be (lower,
    upper) tuples and dead time is not allowed: the paper's stability figures are of this kind.

    Raises InputError for unknown or equal axes, an axis that is not one-dimensional and finite, a tuple on an axis or
    with form="exact" and a dead time with a box form.

    Example:
        >>> import torch
        >>> from avtorch.vehicle.stability import region
        >>> k_s, tau = torch.linspace(0.1, 3.0, 30), torch.tensor([0.5, 2.0])
        >>> plane = region(("k_s", k_s), ("tau", tau), T_L=(0.0, 0.4), K_L=(0.7, 1.0), form="print")
        >>> plane.string.double().mean(-1).round(decimals=2).tolist()  # the region grows with the time gap
        [0.0, 0.23]
    """
    if form not in ("exact", "print", "rigorous"):
        raise InputError(f"form: expected 'exact', 'print' or 'rigorous', found {form!r}")
    x_values, y_values = _axis(x, "x"), _axis(y, "y")
    if x[0] == y[0]:
        raise InputError(f"x, y: expected two different axes, found {x[0]!r} twice")
    held = torch.as_tensor(gains, dtype=torch.float64)
    if held.shape != (3,):
        raise InputError(f"gains: expected three numbers (k_s, k_v, k_a), found shape {tuple(held.shape)}")
    if isinstance(time_gap, tuple):
        raise InputError("time_gap: expected one number [s], found a tuple")
    axes = {x[0]: x_values[None, :], y[0]: y_values[:, None]}
    T, K, tau = axes.get("T", T_L), axes.get("K", K_L), axes.get("tau", time_gap)
    # One gain tensor over the whole plane is cheap, and the callee need not handle axes.
    plane = torch.zeros(y_values.numel(), x_values.numel(), dtype=torch.float64)
    k = torch.stack([plane + axes.get(name, held[i]) for i, name in enumerate(("k_s", "k_v", "k_a"))], -1)
    if form == "exact":
        if isinstance(T, tuple) or isinstance(K, tuple):
            raise InputError("form: bounds on T_L or K_L need form='print' or form='rigorous'")
        local = local_stable(T, K, tau, k, dead_time=dead_time)
        string = string_stable(T, K, tau, k, dead_time=dead_time)
        peak = peak_gain(T, K, tau, k, dead_time=dead_time)
    else:
        if dead_time:
            raise InputError(f"dead_time: Eqs. 2 and 3 know none, found {dead_time:g} s; use form='exact'")
        local = local_conditions(T, K, tau, k, form=form).holds
        string, peak = string_sufficient(T, K, tau, k, form=form), None
    return Region(x[0], x_values, y[0], y_values, form, local, string, peak)


def _axis(axis: Axis, which: str) -> Tensor:
    name, values = axis
    if name not in AXES:
        raise InputError(f"{which}: expected one of {', '.join(AXES)}, found {name!r}")
    points = torch.as_tensor(values, dtype=torch.float64)
    if points.ndim != 1 or points.numel() == 0 or not bool(torch.isfinite(points).all()):
        raise InputError(f"{which}: expected a list of finite values of {name}, found shape {tuple(points.shape)}")
    return points
