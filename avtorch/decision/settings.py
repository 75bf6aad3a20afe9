"""The complete setting of a car-following controller, for many scenarios at once, and how it changes.

Strategy 1 changes the model in the lower level, Strategy 2 the time gap, Strategy 3 the gains of the upper level
(paper, Section 4), and Strategy 4 the feed-forward gain of a vehicle that receives its leader's acceleration (an option
that the paper names). The formulas are in `avtorch.vehicle`; this file only passes the numbers to them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.vehicle import stability
from avtorch.vehicle.arguments import Number, broadcast_shape, checked
from avtorch.vehicle.controllers import NOMINAL_GAINS, RAMP_RATE, LinearController
from avtorch.vehicle.lower_level import LowerLevel
from avtorch.vehicle.stability.conditions import Conditions, Form

DRIVER_TIME_GAPS = (1.0, 1.6, 2.5)
"""Time gaps [s] a driver can choose from in commercial adaptive cruise control (paper, Section 4.5)."""


@dataclass(frozen=True)
class Setting:
    """Everything the strategies may change; each number (scenario,), gains (scenario, 3); any batch shape will do.

    `T_hat` [s], `K_hat` [-]: model in the lower level; `T_d` [s], `K_d` [-]: the actuation it imitates; `time_gap` [s];
    `gains` (k_s [1/s²], k_v [1/s], k_a [-]); `feedforward` k_f [-] on the leader's acceleration, 0 without a link.
    Plain numbers are broadcast. Raises `InputError` for values that are not positive (gains, feedforward: not finite)
    or shapes that do not broadcast.

    Example:
        >>> import torch
        >>> from avtorch import Setting
        >>> tried = Setting(time_gap=torch.tensor([1.0, 1.6, 2.5]))  # three scenarios
        >>> tried.peak_gain(1.5, 0.5).round(decimals=2).tolist()
        [2.24, 1.36, 1.0]
        >>> tried.strategies(Setting(scenarios=3))
        [set(), {2}, {2}]
    """

    T_hat: Tensor
    K_hat: Tensor
    T_d: Tensor
    K_d: Tensor
    time_gap: Tensor
    gains: Tensor
    feedforward: Tensor

    def __init__(
        self,
        T_hat: Number = 0.3,
        K_hat: Number = 1.0,
        T_d: Number = 0.3,
        K_d: Number = 1.0,
        time_gap: Number = 1.0,
        gains: Sequence[float] | Tensor = NOMINAL_GAINS,
        feedforward: Number = 0.0,
        *,
        scenarios: int | None = None,
    ) -> None:
        given = {"T_hat": T_hat, "K_hat": K_hat, "T_d": T_d, "K_d": K_d, "time_gap": time_gap}
        parts = {name: checked(name, value, above=0.0).to(torch.float64) for name, value in given.items()}
        k_f = checked("feedforward", feedforward).to(torch.float64)
        k = checked("gains", gains).to(torch.float64)
        if k.ndim == 0 or k.shape[-1] != 3:
            raise InputError(f"gains: found {tuple(k.shape)} values, need (k_s, k_v, k_a) on the last dimension")
        try:
            shape = broadcast_shape(
                *(v.shape for v in parts.values()), k.shape[:-1], k_f.shape, (1,) if scenarios is None else (scenarios,)
            )
        except RuntimeError as error:
            raise InputError(f"setting: shapes do not broadcast ({error})") from error
        for name, value in parts.items():
            object.__setattr__(self, name, value.expand(shape))
        object.__setattr__(self, "gains", k.expand(*shape, 3))
        object.__setattr__(self, "feedforward", k_f.expand(shape))

    @property
    def shape(self) -> torch.Size:
        return self.time_gap.shape

    def replace(self, **changes: Any) -> Setting:
        """A copy with some fields changed."""
        return dataclasses.replace(self, **changes)

    def map(self, change: Callable[[str, Tensor], Tensor]) -> Setting:
        """`change` of every field's name and tensor."""
        parts: dict[str, Any] = {f.name: change(f.name, getattr(self, f.name)) for f in fields(self)}
        return Setting(**parts)

    def __getitem__(self, index: Any) -> Setting:
        """Some of the scenarios, by index tensor, mask or slice."""
        return self.map(lambda _, x: x[index])

    def lower_level(self, *, accel_min: Number = -6.0, accel_max: Number = 4.0) -> LowerLevel:
        """The lower level of this setting in a vehicle with the given limits [m/s²]."""
        return LowerLevel(self.T_hat, self.K_hat, self.T_d, self.K_d, accel_min, accel_max)

    def amplification(self) -> Tensor:
        """Command effort T_hat K_d / (K_hat T_d) [-], (scenario,)."""
        return self.lower_level().amplification()

    def controller(self, *, standstill: Number = 5.0) -> LinearController:
        """The upper level of this setting, with the time gap at its final value."""
        return LinearController(self.gains, self.time_gap, standstill, self.feedforward)

    def retarget(self, controller: Any, *, at: float, rate: float = RAMP_RATE) -> Any:
        """`controller` moved to this setting from time `at` [s]: gains at once, the time gap at `rate` [s/s]."""
        if isinstance(controller, LinearController):
            return controller.retargeted(
                at=at, time_gap=self.time_gap, gains=self.gains, feedforward=self.feedforward, rate=rate
            )
        return controller.retargeted(at=at, time_gap=float(self.time_gap.reshape(-1)[0]), rate=rate)

    def effective(self, T_L: Tensor, K_L: Tensor) -> tuple[Tensor, Tensor]:
        """Effective (T_e, K_e) of the unclipped loop for draws of the plant (scenario, draw)."""
        return self._law_over_draws.effective(T_L, K_L)

    def p_string_stable(self, T_L: Tensor, K_L: Tensor, *, dead_time: Number = 0.0, link_delay: Number = 0.0) -> Tensor:
        """P(string stable) (scenario,) under draws of the plant (scenario, draw), exact and through (T_e, K_e).

        Fields (scenario, candidate) go with draws (scenario, 1, draw). `dead_time` [s], and `link_delay` [s] of the
        leader's acceleration, are numbers or of the shape of the fields.
        """
        return self._over_draws(stability.p_string_stable, T_L, K_L, dead_time, link_delay)

    def p_locally_and_string_stable(
        self, T_L: Tensor, K_L: Tensor, *, dead_time: Number = 0.0, link_delay: Number = 0.0
    ) -> tuple[Tensor, Tensor]:
        """P(locally stable) and P(string stable), arguments as in `p_string_stable`."""
        return self._over_draws(stability.p_locally_and_string_stable, T_L, K_L, dead_time, link_delay)

    def peak_gain(self, T_L: Number, K_L: Number, *, dead_time: Number = 0.0, link_delay: Number = 0.0) -> Tensor:
        """Peak gain (scenario,) at one plant per scenario, through (T_e, K_e): the score of a choice at the true
        plant."""
        actuation = self.lower_level().effective(T_L, K_L)
        return self._verdict(stability.peak_gain, actuation, dead_time, link_delay)

    def _over_draws(
        self, verdict: Callable[..., Any], T_L: Tensor, K_L: Tensor, dead_time: Number, link_delay: Number
    ) -> Any:
        if isinstance(dead_time, Tensor) and dead_time.ndim:
            dead_time = dead_time.unsqueeze(-1)
        return self._verdict(verdict, self.effective(T_L, K_L), dead_time, link_delay)

    def _verdict(
        self, verdict: Callable[..., Any], actuation: tuple[Tensor, Tensor], dead_time: Number, link_delay: Number
    ) -> Any:
        return verdict(
            *actuation,
            self.time_gap,
            self.gains,
            dead_time=dead_time,
            feedforward=self.feedforward,
            feedforward_delay=link_delay,
        )

    def lower_differs(self, other: Setting) -> Tensor:
        """Whether the lower levels send different commands; shapes broadcast. Models that send equal commands do not
        differ."""
        here, there = self.lower_level(), other.lower_level()
        one, none = torch.ones((), dtype=torch.float64), torch.zeros((), dtype=torch.float64)
        return _differs(here.raw_command(one, none), there.raw_command(one, none)) | _differs(
            here.raw_command(none, one), there.raw_command(none, one)
        )

    def strategies(self, default: Setting) -> list[set[int]]:
        """Which strategies lead from `default` here, one set out of {1, 2, 3, 4} per scenario (of a flat batch)."""
        flags = torch.stack(self._differences(default), dim=-1).expand(*self.shape, 4)
        return [{i + 1 for i, on in enumerate(row) if on} for row in flags.tolist()]

    def differs(self, other: Setting) -> Tensor:
        """Whether anything differs, in the broadcast shape."""
        return torch.stack(self._differences(other)).any(dim=0)

    def _differences(self, other: Setting) -> list[Tensor]:
        lower, gap = self.lower_differs(other), _differs(self.time_gap, other.time_gap)
        gains, link = _differs(self.gains, other.gains).any(dim=-1), _differs(self.feedforward, other.feedforward)
        return list(torch.broadcast_tensors(lower, gap, gains, link))

    def as_dict(self, scenario: int = 0) -> dict[str, Any]:
        """One scenario's setting as in `run.json`: T_hat, K_hat, time_gap_s, gains, the lower level's target, k_f."""
        return {
            "T_hat": float(self.T_hat[scenario]),
            "K_hat": float(self.K_hat[scenario]),
            "time_gap_s": float(self.time_gap[scenario]),
            "gains": [float(k) for k in self.gains[scenario]],
            "T_d": float(self.T_d[scenario]),
            "K_d": float(self.K_d[scenario]),
            "feedforward": float(self.feedforward[scenario]),
        }

    @cached_property
    def _law_over_draws(self) -> LowerLevel:
        """The lower level with a last dimension for draws; a watch asks for it at every window."""
        return LowerLevel(*(x.unsqueeze(-1) for x in (self.T_hat, self.K_hat, self.T_d, self.K_d)))


@dataclass(frozen=True)
class DesignBounds:
    """A box of actuation (scenario,) for a robust controller: `T_L` [s] and `K_L` [-] as (lower, upper) pairs.

    The paper's further option (Section 4): instead of the handbook's [0.1, 0.4] s and [0.7, 1] the box holds most of
    the posterior; `recheck` evaluates the design over it.

    Example:
        >>> import torch
        >>> from avtorch.decision import DesignBounds
        >>> T_L = torch.linspace(0.2, 0.4, 101, dtype=torch.float64).unsqueeze(0)  # draws of one car
        >>> box = DesignBounds.of_belief(T_L, torch.full_like(T_L, 0.9))
        >>> local, string = box.recheck(time_gap=1.0, gains=(1.5, 1.5, -0.8))
        >>> local.holds.tolist(), string.holds.tolist()
        ([True], [True])
    """

    T_L: tuple[Tensor, Tensor]
    K_L: tuple[Tensor, Tensor]

    @staticmethod
    def of_belief(T_L: Tensor, K_L: Tensor, *, coverage: float = 0.95) -> DesignBounds:
        """The box that holds at least `coverage` of the draws (scenario, draw).

        Each parameter's interval leaves out (1 - coverage)/2, a quarter of 1 - coverage at each end, so the box has at
        least this coverage for any correlation of the two. Raises `InputError` for a coverage outside (0, 1).
        """
        if not 0.0 < coverage < 1.0:
            raise InputError(f"coverage: found {coverage}, need a number between 0 and 1")
        tail = (1.0 - coverage) / 4.0

        def pair(draws: Tensor) -> tuple[Tensor, Tensor]:
            low, high = torch.quantile(
                draws, torch.tensor([tail, 1.0 - tail], dtype=draws.dtype, device=draws.device), dim=-1
            )
            return low, high

        return DesignBounds(pair(T_L), pair(K_L))

    def recheck(
        self, time_gap: Number, gains: Sequence[float] | Tensor, *, form: Form = "rigorous"
    ) -> tuple[Conditions, Conditions]:
        """Eq. 2 (local) and Eq. 3 (string, sufficient) of the robust design over this box, margins (scenario, line).

        `form` as in `stability.string_conditions`: "print" is the paper's. Of the vehicle itself; where the lower
        level inverts a model, make the box of `setting.effective(T_L, K_L)`.
        """
        return (
            stability.local_conditions(self.T_L, self.K_L, time_gap, gains, form=form),
            stability.string_conditions(self.T_L, self.K_L, time_gap, gains, form=form),
        )


def _differs(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).abs() > 1e-9 * (1.0 + b.abs())
