"""Tables of what a watch saw: its windows, its alerts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from avtorch.report.table import Table

P_WORDS = "P: probability of string stability under the setting in force"
MOST = 500
"""Windows that a table shows, evenly spaced: a day of them would make a page of megabytes."""


def window_table(windows: Sequence[Mapping[str, Any]]) -> Table:
    """A row a window, in the form of an answer: bounds [s], rows, T_L and K_L with 90 %, P(string stable), remarks."""
    columns = ("time [s]", "rows", "T_L [s] (90 %)", "K_L (90 %)", "P", "remarks")
    step = _step(windows)
    shown = windows[::step]
    rows = tuple(_row(w) for w in shown)
    marked = [i for i, w in enumerate(shown) if w["alerts"]]
    soft = [i for i, w in enumerate(shown) if not w["used"] and not w["alerts"]]
    return Table(
        f"Lag and gain, {_which(step)}; {P_WORDS}", columns, rows, numeric=("rows", "P"), marked=marked, soft=soft
    )


def probability_table(windows: Sequence[Mapping[str, Any]]) -> Table:
    """P(string stable) when each window ended, and the alerts then."""
    step = _step(windows)
    rows = tuple((_seconds(w["end_s"]), f"{w['p_string_stable']:.2f}", ", ".join(w["alerts"])) for w in windows[::step])
    columns = ("known at [s]", "P(string stable)", "alerts")
    return Table(f"P(string stable), {_which(step)}", columns, rows, numeric=columns[1:2])


def alert_table(alerts: Sequence[Mapping[str, Any]]) -> Table:
    """The first alert of each detector, and how many windows raised it: one that nobody answers comes again."""
    first: dict[str, Mapping[str, Any]] = {}
    for alert in alerts:
        first.setdefault(alert["detector"], alert)
    rows = [
        (f"{a['time_s']:.1f}", name, a["why"], str(sum(x["detector"] == name for x in alerts)))
        for name, a in first.items()
    ]
    columns = ("first at [s]", "detector", "why", "windows")
    return Table("Alerts, each detector's first", columns, tuple(rows), numeric=("windows",))


def _step(windows: Sequence[Mapping[str, Any]]) -> int:
    return max(1, -(-len(windows) // MOST))


def _which(step: int) -> str:
    return f"one of {step} windows" if step > 1 else "window by window"


def _row(w: Mapping[str, Any]) -> tuple[str, ...]:
    own = [f"{w[n]['mean']:.3f} ({w[n]['q05']:.2f}-{w[n]['q95']:.2f})" for n in ("T_L", "K_L")]
    unused = "not converged" if w["excited"] else "not excited"
    remarks = ", ".join(w["alerts"]) if w["alerts"] else "" if w["used"] else unused
    span = f"{_seconds(w['start_s'])} to {_seconds(w['end_s'])}"
    return (span, str(w["n"]), *own, f"{w['p_string_stable']:.2f}", remarks)


def _seconds(time: float) -> str:
    return f"{time:.2f}".rstrip("0").rstrip(".")
