"""Upper level: the demanded acceleration as a function of the follower's state.

A controller is any callable `controller(state: FollowerState) -> demanded acceleration (..., scenario)`: the linear
law here, the MPC in `mpc.py`, a policy network, a function of unknown structure.

A time gap moves at a limited rate, so that a new setting does not cause a jump of the spacing error: from 1 to 2.5 s at
27 m/s the wanted spacing grows by 40 m; applied at once, `k_s` times 40 m is an emergency stop. The ramp is a function
of time alone (no state): a controller stays a pure function of its inputs, and a copied loop replays the same ramp.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number, checked

RAMP_RATE = 0.1
"""Rate of the time gap [s/s]. While the gap opens, the follower falls behind by this fraction of its speed per second.

With the nominal controller 0.1 costs a peak braking of 1.2 m/s² at 30 m/s: below the 2 m/s² that count as comfortable,
with room for a slower actuator. 1 to 2.5 s then takes 15 s.
"""


@dataclass(frozen=True)
class TimeGap:
    """From `start` to `target` [s] at no more than `rate` [s/s], beginning at `since` [s]; floats or (scenario,).

    Before `since` the gap is `start` (a driver who complies later: `since` in the future). Raises `InputError` for
    gaps < 0 or `rate <= 0`.
    """

    target: Number
    start: Number
    since: float = 0.0
    rate: float = RAMP_RATE
    _done: float = field(init=False, repr=False, compare=False)
    _start: Float[Tensor, "*#setting"] = field(init=False, repr=False, compare=False)
    _step: Float[Tensor, "*#setting"] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        target = checked("time_gap", self.target, unit="s", least=0.0)
        start = checked("time_gap start", self.start, unit="s", least=0.0)
        if not self.rate > 0:
            raise InputError(f"time gap rate: found {self.rate!r}, needs a number > 0 s/s")
        if not math.isfinite(self.since):
            raise InputError(f"time gap since: found {self.since!r}, needs a finite time in s")
        step = target - start
        object.__setattr__(self, "_start", start)
        object.__setattr__(self, "_step", step)
        object.__setattr__(self, "_done", self.since + float(step.abs().max()) / self.rate)

    @property
    def done_at(self) -> float:
        """Time [s] from which the gap is the target in every scenario."""
        return self._done

    def at(self, time: float) -> Float[Tensor, "*setting"]:
        """The gap [s] in force at `time` [s]."""
        room = self.rate * max(time - self.since, 0.0)
        return self._start + torch.clamp(self._step, -room, room)


NOMINAL_GAINS = (1.5, 1.5, -0.8)
"""Gains (k_s [1/s²], k_v [1/s], k_a [-]) of the upper level by default (Table 1 of the paper)."""


class FollowerState(NamedTuple):
    """Inputs of the controller at one tick. `time` [s] is a float, the same for all; the rest are tensors (...,
    scenario).

    `lead_accel` is what the link delivers: the leader's acceleration `link_delay` ago (see `ClosedLoop`).

    Example:
        >>> import torch
        >>> from avtorch.vehicle import FollowerState, LinearController
        >>> x = torch.tensor([30.0, 20.0, 0.0, 19.0, 0.0], dtype=torch.float64)
        >>> state = FollowerState(0.0, *x.unsqueeze(-1))  # one scenario: 5 m too far back, closing in at 1 m/s
        >>> LinearController()(state).tolist()
        [6.0]
    """

    time: float
    spacing: Float[Tensor, "*#scenario"]
    speed: Float[Tensor, "*#scenario"]
    accel: Float[Tensor, "*#scenario"]
    lead_speed: Float[Tensor, "*#scenario"]
    lead_accel: Float[Tensor, "*#scenario"]


Controller = Callable[[FollowerState], Tensor]
"""Takes a follower's state, returns the demanded acceleration [m/s²]."""


@dataclass(frozen=True)
class LinearController:
    """Constant-time-gap law `u = k_s Δs + k_v Δv + k_a a + k_f a_lead`, demanded acceleration [m/s²].

    `Δs = spacing - (time_gap speed + standstill)`, `Δv = lead_speed - speed`.

    `gains` (k_s [1/s²], k_v [1/s], k_a [-]) on the last dimension, (..., 3); `time_gap` [s], `standstill` [m] and
    `feedforward` k_f [-] floats or tensors; all broadcast with (..., scenario). `ramp`, if given, moves the gap toward
    `time_gap` (made by `retargeted`). Frozen: a new setting is a new object. Raises `InputError` for non-finite values,
    gains that are not three, or a negative time gap or standstill spacing.

    Example:
        >>> from avtorch.vehicle import Leader, LinearController, simulate
        >>> longer = LinearController().retargeted(at=5.0, time_gap=1.6)
        >>> leader = Leader.constant(speed=20.0, duration=30.0, dt=0.05)
        >>> run = simulate(leader, schedule=[(5.0, {"controller": longer})])
        >>> [round(float(x), 1) for x in run.spacing[0, 0, [0, -1]]]  # 0.6 s at 20 m/s: 12 m more
        [25.0, 37.0]
    """

    gains: Sequence[float] | Tensor = NOMINAL_GAINS
    time_gap: Number = 1.0
    standstill: Number = 5.0
    feedforward: Number = 0.0
    ramp: TimeGap | None = None
    _k: tuple[Tensor, Tensor, Tensor] = field(init=False, repr=False, compare=False)
    _final: tuple[Tensor, Tensor] = field(init=False, repr=False, compare=False)
    _k_f: Tensor | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        gains = checked("gains", self.gains)
        if gains.dim() == 0 or gains.shape[-1] != 3:
            raise InputError(f"gains: found shape {tuple(gains.shape)}, needs k_s, k_v, k_a on the last dimension")
        k_s, k_v, k_a = gains.unbind(-1)
        gap = checked("time_gap", self.time_gap, unit="s", least=0.0)
        rest = checked("standstill", self.standstill, unit="m", least=0.0)
        k_f = checked("feedforward", self.feedforward)
        object.__setattr__(self, "_k", (k_s, k_v, k_a))
        object.__setattr__(self, "_final", (-(k_s * gap + k_v), -k_s * rest))
        object.__setattr__(self, "_k_f", k_f if bool((k_f != 0).any()) else None)

    def __call__(self, state: FollowerState) -> Float[Tensor, "*scenario"]:
        k_s, k_v, k_a = self._k
        on_speed, constant = self._final
        if self.ramp is not None and state.time < self.ramp.done_at:
            on_speed = -(k_s * self.ramp.at(state.time) + k_v)
        u = torch.addcmul(constant, k_s, state.spacing)
        u = torch.addcmul(u, k_v, state.lead_speed)
        u = torch.addcmul(u, on_speed, state.speed)
        u = torch.addcmul(u, k_a, state.accel)
        return u if self._k_f is None else torch.addcmul(u, self._k_f, state.lead_accel)

    def time_gap_at(self, time: float) -> Float[Tensor, "*setting"]:
        """The time gap [s] in force at `time` [s], on its way to `time_gap`."""
        return checked("time_gap", self.time_gap) if self.ramp is None else self.ramp.at(time)

    def retargeted(
        self,
        *,
        at: float,
        time_gap: Number,
        gains: Sequence[float] | Tensor | None = None,
        feedforward: Number | None = None,
        rate: float = RAMP_RATE,
    ) -> LinearController:
        """The same controller with new settings from time `at` [s] on; the gap moves there at `rate` [s/s].

        It starts from the gap in force at `at`, so a ramp may be retargeted midway. `at` later than the time of the
        call is a driver's compliance delay (gains and feed-forward change at once).
        """
        return dataclasses.replace(
            self,
            gains=self.gains if gains is None else gains,
            feedforward=self.feedforward if feedforward is None else feedforward,
            time_gap=time_gap,
            ramp=TimeGap(target=time_gap, start=self.time_gap_at(at), since=at, rate=rate),
        )
