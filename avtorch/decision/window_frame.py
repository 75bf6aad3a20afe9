"""The windows of a drive as a table: a row a window and scenario."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from avtorch.decision.watch import WatchedWindow
from avtorch.display import Frame


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
