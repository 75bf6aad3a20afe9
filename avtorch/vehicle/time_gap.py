"""A time gap that moves at a limited rate, so that a new setting does not cause a jump of the spacing error.

From 1 to 2.5 s at 27 m/s the wanted spacing grows by 40 m: applied at once, `k_s` times 40 m is an emergency stop.
The ramp is a function of time alone (no state): a controller stays a pure function of its inputs, and a copied loop
replays the same ramp.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from avtorch.arrays import Float
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number, checked

RAMP_RATE = 0.1
"""Rate of the time gap [s/s]. While the gap opens, the follower falls behind by this fraction of its speed per second.

With the nominal controller 0.1 costs a peak braking of 1.2 m/s² at 30 m/s: below the 2 m/s² that count as comfortable,
with room for a slower actuator. 1 to 2.5 s then takes 15 s.

Example:
    >>> from avtorch.vehicle import RAMP_RATE, TimeGap
    >>> round(0.6 / RAMP_RATE, 1), round(TimeGap(target=1.6, start=1.0).done_at, 1)  # 0.6 s more take 6 s
    (6.0, 6.0)
"""


@dataclass(frozen=True)
class TimeGap:
    """From `start` to `target` [s] at no more than `rate` [s/s], beginning at `since` [s]; floats or (scenario,).

    Before `since` the gap is `start` (a driver who complies later: `since` in the future). Raises `InputError` for
    gaps < 0 or `rate <= 0`.

    Example:
        >>> from avtorch.vehicle import TimeGap
        >>> gap = TimeGap(target=1.6, start=1.0, since=10.0)
        >>> [float(gap.at(t).round(decimals=3)) for t in (9.0, 12.0, 20.0)]
        [1.0, 1.2, 1.6]
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
