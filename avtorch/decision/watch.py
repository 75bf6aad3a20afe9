"""Belief and monitor on one stream of samples, used by both `estimate` and the supervisor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from avtorch.decision.monitor import Monitor, MonitorReport
from avtorch.decision.settings import Setting
from avtorch.display import Card, Displayed, Frame
from avtorch.errors import InputError
from avtorch.inference.stream import BeliefStream, Window


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
