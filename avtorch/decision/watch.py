"""Belief and monitor on one stream of samples, used by both `estimate` and the supervisor, and its run's record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from torch import Tensor

from avtorch.decision.monitor import Monitor, MonitorReport
from avtorch.decision.settings import Setting
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.inference.stream import BeliefStream, Window
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
    """A supervised run: `rows` (scenario, time), `windows`, and per scenario its `actions`.

    Example:
        >>> from avtorch import BeliefStream, ClosedLoop, Leader, Supervisor
        >>> loop = ClosedLoop(Leader.default(start=50.0, duration=4.0, dt=0.02))
        >>> run = Supervisor(loop, stream=BeliefStream(estimator="map")).run(4.0)
        >>> tuple(run.rows.speed.shape), len(run.windows), run.alerts, run.actions
        ((1, 200), 2, [[]], [[]])
    """

    rows: Block
    windows: list[WatchedWindow]
    actions: list[list[Action]]

    @cached_property
    def alerts(self) -> list[list[Alert]]:
        """Of each scenario, in the order of time."""
        return [
            [Alert(w.window.end_s, name, w.report.why(name, i)) for w in self.windows for name in w.report.names(i)]
            for i in range(len(self.actions))
        ]

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


@dataclass(frozen=True, repr=False)
class WatchedWindow(Displayed):
    """A window's belief and the monitor's report on it under the `setting` in force."""

    window: Window
    report: MonitorReport
    setting: Setting

    def overview(self) -> Card:
        """The window, and the monitor's alerts in the first scenario."""
        below = self.window.overview()
        alerts = [self.report.why(name) for name in self.report.names()]
        lines = (*below.lines, *(alerts or ["No alert."]))
        return Card(below.title, lines, below.table, below.most)


class Watch:
    """A `stream` of beliefs about many vehicles with a `monitor` behind it, one scenario a vehicle.

    Raises `InputError` where their numbers of vehicles and scenarios differ.
    """

    def __init__(self, stream: BeliefStream, monitor: Monitor | None = None) -> None:
        self.stream = stream
        self.monitor = Monitor(stream.vehicles) if monitor is None else monitor
        if self.monitor.scenarios != stream.vehicles:
            raise InputError(f"monitor: found {self.monitor.scenarios} scenarios, needs the stream's {stream.vehicles}")

    def feed(
        self,
        time: Tensor,
        columns: Mapping[str, Tensor],
        setting: Setting,
        *,
        usable: Tensor | None = None,
        engaged: Tensor | None = None,
        until: float | None = None,
    ) -> list[WatchedWindow]:
        """Take in rows, return watched windows; arguments as `BeliefStream.feed`, `setting` is in force over these
        rows."""
        windows = self.stream.feed(time, columns, usable=usable, engaged=engaged, until=until)
        return [self._watch(w, setting) for w in windows]

    def flush(self, setting: Setting) -> list[WatchedWindow]:
        """Close the open window early (the drive ends or a gap follows)."""
        return [self._watch(w, setting) for w in self.stream.flush()]

    def _watch(self, window: Window, setting: Setting) -> WatchedWindow:
        belief = window.belief
        # decisions are made on the processor, wherever the belief is
        T_L, K_L = (belief.draws[..., i].mT.cpu() for i in range(2))
        used = (belief.excited & belief.converged).cpu()
        return WatchedWindow(window, self.monitor.update(T_L, K_L, used, setting), setting)

    def state_dict(self) -> dict[str, Any]:
        """Belief, open window and monitor: a resumed watch continues bit for bit."""
        return {"stream": self.stream.state_dict(), "monitor": self.monitor.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`; raises `InputError`, and changes nothing, where the state is another watch's."""
        if not isinstance(state, dict) or set(state) != {"stream", "monitor"}:
            raise InputError("state: is not a watch's; needs stream and monitor")
        before = self.stream.state_dict()
        self.stream.load_state_dict(state["stream"])
        try:
            self.monitor.load_state_dict(state["monitor"])
        except InputError:
            self.stream.load_state_dict(before)
            raise


def window_frame(windows: Sequence[WatchedWindow]) -> Frame:
    """Bounds [s], rows, whether the window was used, each parameter's figures, P(string stable) and alerts."""
    rows: list[dict[str, Any]] = []
    for watched in windows:
        window, belief = watched.window, watched.window.belief
        for scenario in range(len(belief.excited)):
            stats = {name: belief.stat(name, scenario) for name in belief.names}
            rows.append(
                {
                    "scenario": scenario,
                    "start_s": window.start_s,
                    "end_s": window.end_s,
                    "rows": int(window.n[scenario]),
                    "used": bool(belief.excited[scenario] & belief.converged[scenario]),
                    **{f"{name}_{key}": value for name, given in stats.items() for key, value in given.items()},
                    "p_string_stable": float(watched.report.p_string_stable[scenario]),
                    "alerts": ", ".join(watched.report.names(scenario)),
                }
            )
    return Frame.of_rows(rows)
