"""What a supervised run leaves behind: rows, windows, alerts and actions."""

from __future__ import annotations

from dataclasses import dataclass

from avtorch.decision.settings import Setting
from avtorch.decision.watch import WatchedWindow
from avtorch.vehicle.block import Block


@dataclass(frozen=True)
class Alert:
    """`detector` was alarmed at `time_s`, the end of a window; `why` in one sentence."""

    time_s: float
    detector: str
    why: str


@dataclass(frozen=True)
class Action:
    """A new setting, in force from `time_s` on, for one scenario.

    `strategies` lead to `setting` (of shape ``(1,)``) from the default; `sufficient` tells whether it meets the
    strategist's conditions. `peak_gain_true`: the exact peak gain at the true vehicle, None where there is no truth.
    `driver_delay_s`: where a driver was asked for the time gap, how long until it begins to move; else 0.
    """

    time_s: float
    strategies: list[int]
    setting: Setting
    why: str
    sufficient: bool
    p_string_stable: float
    peak_gain_true: float | None
    driver_delay_s: float = 0.0


@dataclass(frozen=True)
class SupervisedRun:
    """What a supervised run leaves: `rows` (scenario, time), `windows`, and per scenario its `alerts` and `actions`."""

    rows: Block
    windows: list[WatchedWindow]
    alerts: list[list[Alert]]
    actions: list[list[Action]]
