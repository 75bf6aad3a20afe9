"""The record of a supervised run: rows, windows, alerts and actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from avtorch.decision.settings import Setting
from avtorch.decision.watch import WatchedWindow, window_frame
from avtorch.display import Card, Displayed, Frame
from avtorch.vehicle.block import Block

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class Alert:
    """`detector` raised an alarm at `time_s`, the end of a window; `why` in one sentence."""

    time_s: float
    detector: str
    why: str


@dataclass(frozen=True)
class Action:
    """A new setting, in force from `time_s` on, for one scenario.

    `strategies` lead to `setting` (of shape ``(1,)``) from the default; `sufficient`: whether it meets the strategist's
    conditions. `peak_gain_true`: the exact peak gain at the true vehicle, None where the truth is unknown.
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


@dataclass(frozen=True, repr=False)
class SupervisedRun(Displayed):
    """A supervised run: `rows` (scenario, time), `windows`, and per scenario its `alerts` and `actions`.

    Example:
        >>> from avtorch import BeliefStream, ClosedLoop, Leader, Supervisor
        >>> loop = ClosedLoop(Leader.default(start=50.0, duration=4.0, dt=0.02))
        >>> run = Supervisor(loop, stream=BeliefStream(estimator="map")).run(4.0)
        >>> tuple(run.rows.speed.shape), len(run.windows), run.alerts, run.actions
        ((1, 200), 2, [[]], [[]])
    """

    rows: Block
    windows: list[WatchedWindow]
    alerts: list[list[Alert]]
    actions: list[list[Action]]

    def overview(self) -> Card:
        """What was driven, what was seen and done in the first scenario, and the first scenarios in figures."""
        title = f"Supervised run: {self.rows.extent()}; {len(self.windows)} windows"
        lines = []
        if self.alerts and self.alerts[0]:
            first = self.alerts[0][0]
            lines.append(f"First alert: {first.time_s:g} s, {first.detector}: {first.why}")
        if self.actions and self.actions[0]:
            done = self.actions[0][0]
            lines.append(
                f"First action: {done.time_s:g} s, strategies {', '.join(map(str, done.strategies))}: {done.why}"
            )
        rows = [
            {
                "scenario": i,
                "alerts": len(alerts),
                "actions": len(actions),
                "least spacing [m]": float(self.rows.spacing[i].min()),
                "collided": bool(self.rows.collided[i]),
            }
            for i, (alerts, actions) in enumerate(zip(self.alerts, self.actions, strict=True))
        ]
        return Card(title, tuple(lines), Frame.of_rows(rows))

    def to_dataframe(self) -> pandas.DataFrame:
        """A row a window and scenario (of samples: `rows.to_dataframe()`). Needs ``pip install 'avtorch[pandas]'``."""
        return window_frame(self.windows).to_dataframe()
