"""Stability under a belief: probabilities and intervals over draws of the actuation, for many settings at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Float, Real
from avtorch.errors import InputError
from avtorch.vehicle.stability.exact import coefficients
from avtorch.vehicle.stability.linear_loop import Gains, LinearLoop, Value, as_tensor, linear_loop
from avtorch.vehicle.stability.local_and_string import locally_stable, peak_gain_of, string_stable_of
from avtorch.vehicle.stability.nyquist import lost_at

Drawn = float | Real[Tensor, ""] | Real[Tensor, "*#setting #draw"]

BLOCK = 1 << 15  # (setting, draw) pairs held at a time: the temporaries then stay in the cache


class Interval(NamedTuple):
    """Median and 90 % interval, each (setting,) or of the settings' shape: order statistics, so inf is allowed."""

    q05: Float[Tensor, "*setting"]
    q50: Float[Tensor, "*setting"]
    q95: Float[Tensor, "*setting"]


@dataclass(frozen=True)
class StabilityBelief:
    """Stability of each setting under a belief; every tensor has the settings' shape.

    p_locally_stable, p_string_stable: shares of the draws. error: their Monte Carlo standard error at most, as if the
    draws were independent (Agresti-Coull, so it is above zero even at a share of 0 or 1). margins: intervals of

    - local [1/s]: `(1/K - k_a) g - T k_s / K`, the last line of Eq. 2 (> 0 stable), without dead time;
    - B [-] and C_over_K [1/s^2]: the lines of Eq. 3, without dead time;
    - dead_time [s]: how much more dead time the loop tolerates before it becomes locally unstable;
    - peak_gain [-]: with dead time; inf where locally unstable.
    """

    p_locally_stable: Float[Tensor, "*setting"]
    p_string_stable: Float[Tensor, "*setting"]
    error: Float[Tensor, "*setting"]
    margins: dict[str, Interval]


def p_string_stable(
    T_L: Drawn,
    K_L: Drawn,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Drawn = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> Float[Tensor, "*setting"]:
    """P(string stable) of every setting under draws of the actuation, shape (setting,) or that of the settings.

    The vehicle, T_L [s], K_L [-] and dead_time [s], has its draws on the last dimension: (draw,) for all settings
    alike, or (setting, draw) where a setting changes it (a lower level: effective T_L and K_L). Numbers are known
    values. The settings, time_gap (setting,), gains (setting, 3), feedforward [-] and its delay [s], broadcast with
    each other. Draws that leave the loop without a stable actuator (T_L < 0 or infinite, K_L <= 0) count as unstable.
    Raises InputError as `string_stable`, and where there is no draw.

    Example:
        >>> import torch
        >>> from avtorch.vehicle.stability import p_string_stable
        >>> T_L = torch.linspace(0.2, 1.8, 161, dtype=torch.float64)  # draws of the lag
        >>> gains = torch.tensor([[1.5, 1.5, -0.8], [3.0, 3.0, -1.8]])  # two settings
        >>> p_string_stable(T_L, 0.6, time_gap=1.0, gains=gains).round(decimals=2).tolist()
        [0.0, 0.52]
    """
    blocks = _Blocks(T_L, K_L, time_gap, gains, dead_time, feedforward, feedforward_delay)
    return blocks.share(string_stable_of)


def p_locally_and_string_stable(
    T_L: Drawn,
    K_L: Drawn,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Drawn = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> tuple[Float[Tensor, "*setting"], Float[Tensor, "*setting"]]:
    """P(locally stable) and P(string stable), arguments as in `p_string_stable`."""
    blocks = _Blocks(T_L, K_L, time_gap, gains, dead_time, feedforward, feedforward_delay)
    return blocks.share(locally_stable), blocks.share(string_stable_of)


def stability_belief(
    T_L: Drawn,
    K_L: Drawn,
    time_gap: Value,
    gains: Gains,
    *,
    dead_time: Drawn = 0.0,
    feedforward: Value = 0.0,
    feedforward_delay: Value = 0.0,
) -> StabilityBelief:
    """Probabilities and margins with intervals, arguments as in `p_string_stable`."""
    blocks = _Blocks(T_L, K_L, time_gap, gains, dead_time, feedforward, feedforward_delay)
    margins: dict[str, list[Interval]] = {}
    for s in blocks:
        for name, draws in _margins(s).items():
            margins.setdefault(name, []).append(_interval(s.full(draws)))
    p_string, n = blocks.share(string_stable_of), blocks.draws
    shrunk = (p_string * n + 2) / (n + 4)
    return StabilityBelief(
        p_locally_stable=blocks.share(locally_stable),
        p_string_stable=p_string,
        error=(shrunk * (1 - shrunk) / (n + 4)).sqrt(),
        margins={k: Interval(*(blocks.join(list(q)) for q in zip(*v, strict=True))) for k, v in margins.items()},
    )


def _margins(s: LinearLoop) -> dict[str, Tensor]:
    B, C = coefficients(s)
    rows = {
        "local": (1 / s.K - s.ka) * s.g - s.T * s.ks / s.K,
        "B": B,
        "C_over_K": C / s.K,
        "dead_time": lost_at(s) - s.theta,
    }
    rows = {name: torch.where(s.valid, row, torch.full_like(row, -torch.inf)) for name, row in rows.items()}
    return rows | {"peak_gain": peak_gain_of(s)}


def _interval(draws: Float[Tensor, "setting draw"]) -> Interval:
    ordered = draws.sort(-1).values
    n = ordered.shape[-1]
    return Interval(*(ordered[..., min(n - 1, int(q * n))] for q in (0.05, 0.5, 0.95)))


class _Blocks:
    """Divides (setting, draw) into row blocks that fit in memory, and restores the shape of per-setting results."""

    def __init__(
        self,
        T_L: Drawn,
        K_L: Drawn,
        time_gap: Value,
        gains: Gains,
        dead_time: Drawn,
        feedforward: Value,
        feedforward_delay: Value,
    ) -> None:
        like = [T_L, K_L, time_gap, gains, dead_time, feedforward, feedforward_delay]
        names = ("T_L", "K_L", "dead_time")
        plant = [as_tensor(x, like, n) for x, n in zip((T_L, K_L, dead_time), names, strict=True)]
        # Known numbers are draws that never vary.
        plant = [x.reshape(1) if x.ndim == 0 else x for x in plant]
        law = [as_tensor(x, like, "setting").unsqueeze(-1) for x in (time_gap, feedforward, feedforward_delay)]
        k = as_tensor(gains, like, "gains")
        if k.ndim == 0 or k.shape[-1] != 3:
            raise InputError(f"gains: expected (k_s, k_v, k_a) on the last dimension, found shape {tuple(k.shape)}")
        self.setting = linear_loop(
            plant[0],
            plant[1],
            law[0],
            k.unsqueeze(-2),
            dead_time=plant[2],
            feedforward=law[1],
            feedforward_delay=law[2],
        )
        self.shape = self.setting.shape[:-1]
        self.draws = self.setting.shape[-1]
        if self.draws == 0:
            raise InputError("T_L, K_L: expected at least one draw, found none")

    def __iter__(self) -> Iterator[LinearLoop]:
        count = self.shape.numel()
        if 0 < count * self.draws <= BLOCK and len(self.shape) == 1:
            yield self.setting.map(torch.detach)  # what is the same for all draws need not be expanded
            return
        s = self.setting.map(lambda x: x.detach().expand(*self.shape, x.shape[-1]).reshape(count, x.shape[-1]))
        rows = max(1, BLOCK // self.draws)
        for start in range(0, count, rows):
            yield s.map(lambda x, start=start: x[start : start + rows])

    def share(self, verdict: Callable[[LinearLoop], Tensor]) -> Float[Tensor, "*setting"]:
        """The share of the draws for which `verdict` holds."""
        return self.join([s.full(verdict(s)).double().mean(-1) for s in self])

    def join(self, parts: list[Tensor]) -> Tensor:
        if not parts:
            return torch.zeros(self.shape, dtype=torch.float64)
        return torch.cat(parts).reshape(self.shape)
