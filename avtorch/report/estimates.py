"""The page of an estimate: lag and gain window by window, alerts, P(string stable); its tables and sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from avtorch.io.clock import from_start
from avtorch.plots.time import TARGET, belief_figure, probability_figure
from avtorch.report.page import Origin, Page, Picture, Section, Tone, picture_of
from avtorch.report.table import Table
from avtorch.results import estimates_answer

if TYPE_CHECKING:
    from avtorch.decision.dead_time import InferredDeadTime
    from avtorch.decision.estimation import Estimates
    from avtorch.io import Log
    from avtorch.logcheck.late_channel import LateChannel


def estimates_html(found: Estimates, log: Log, *, notes: Iterable[str] = (), origin: Origin | None = None) -> str:
    """The page of the estimate `found` on `log`, as text; `notes`: on the data, beside those of its check."""
    answer = estimates_answer(found)
    epoch_s = answer["epoch_s"]
    windows, alerts = (from_start(answer[key], epoch_s) for key in ("windows", "alerts"))
    facts = f"{log.name} · {len(windows)} windows of {windows[0]['end_s'] - windows[0]['start_s']:g} s"
    spread = answer["spread_over_sd"]
    told = (estimates_note(answer), *_stability(windows, answer["assumed"]))
    more = (late_note(found.late), dead_time_note(found.inferred))
    page = Page(
        "Estimate",
        facts,
        Section(_headline(windows, spread), (*told, *(text for text in more if text)), (_belief(answer, log),)),
        (
            Section("String stability", pictures=(_probability(answer),)),
            Section("Alerts", () if alerts else ("None.",), tables=(alert_table(alerts),)),
            Section("The data", items=(*found.quality.notes, *notes)),
            Section("Method and limits", items=_method(answer)),
        ),
        _tone(windows, spread),
    )
    return page.html(origin)


_UNITS = {"T_L": " s", "K_L": ""}


def _headline(windows: Sequence[Mapping[str, Any]], spread_over_sd: Mapping[str, float | None]) -> str:
    used = [w for w in windows if w["used"]]
    if not used:
        return "No window could be used: lag and gain are not known"
    if unexplained(spread_over_sd):
        ends = {n: (f(w[n]["mean"] for w in used) for f in (min, max)) for n in ("T_L", "K_L")}
        told = ", ".join(f"{n} {low:.2f} to {high:.2f}{_UNITS[n]}" for n, (low, high) in ends.items())
        return f"One lag and one gain do not explain this log: {told} by window"
    last = used[-1]
    lag, gain = (
        f"{last[n]['mean']:.3f}{unit} (90 % {last[n]['q05']:.3f} to {last[n]['q95']:.3f})" for n, unit in _UNITS.items()
    )
    return f"Lag T_L {lag}, gain K_L {gain}"


def _stability(windows: Sequence[Mapping[str, Any]], assumed: Mapping[str, Any]) -> tuple[str, ...]:
    if not any(w["used"] for w in windows):
        return ()
    last, least = windows[-1], min(windows, key=lambda w: w["p_string_stable"])
    gains = ", ".join(f"{k:g}" for k in assumed["gains"])
    lowest = f"; the lowest was {least['p_string_stable']:.2f} at {least['end_s']:.0f} s" if least is not last else ""
    return (
        f"With a time gap of {assumed['time_gap_s']:g} s and gains {gains}, P(string stable) is "
        f"{last['p_string_stable']:.2f} after the last window{lowest}.",
    )


def _tone(windows: Sequence[Mapping[str, Any]], spread_over_sd: Mapping[str, float | None]) -> Tone:
    if unexplained(spread_over_sd) or not any(w["used"] for w in windows):
        return "amber"
    return "green" if windows[-1]["p_string_stable"] >= TARGET else "amber"


def _belief(answer: Mapping[str, Any], log: Log) -> Picture:
    return picture_of(
        "belief",
        belief_figure(answer, log=log),
        window_table(from_start(answer["windows"], answer["epoch_s"])),
        caption="Grey: a window that excited too little, or did not converge; the belief before it is carried over.",
    )


def _probability(answer: Mapping[str, Any]) -> Picture:
    return picture_of(
        "probability",
        probability_figure(answer),
        probability_table(from_start(answer["windows"], answer["epoch_s"])),
        caption="Known at the end of each window: a dot, larger and red below the target.",
    )


def _method(answer: Mapping[str, Any]) -> tuple[str, ...]:
    assumed = answer["assumed"]
    form = {"jerk": "the measured jerk", "latent": "noisy acceleration and speed"}[answer["form"]]
    found = [
        f"da/dt = -a/T_L + K_L/T_L u + noise; the likelihood is that of {form}, each window's posterior is the next "
        f"one's prior, by the estimator {answer['estimator']}.",
        f"Commands take effect after a dead time of {assumed['dead_time_s']:g} s.",
        "The log does not hold its controller: P(string stable) is that of the linear one with the gap and gains "
        "above, for small motions.",
        f"Alerts of accepted_change compare with T_L {assumed['accepted']['T_L']:g} s and K_L "
        f"{assumed['accepted']['K_L']:g}, a car as it should be.",
    ]
    return (*found, answer["estimator_note"]) if answer["estimator_note"] else tuple(found)


# tables and sentences, for the terminal, too ----------------------------------------------------------------------
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


UNEXPLAINED = 1.5
"""`Estimates.spread_ratio` above which a single lag and gain do not describe the log."""


def unexplained(spread_over_sd: Mapping[str, float | None]) -> bool:
    """Whether estimates scatter by more than their intervals allow, from window to window."""
    return any((x or 0.0) > UNEXPLAINED for x in spread_over_sd.values())


def dead_time_note(inferred: InferredDeadTime | None) -> str:
    """What the log says of the dead time, in one sentence; empty where it was not inferred."""
    if inferred is None:
        return ""
    span = f"90 % of its probability from {inferred.q05:.2f} to {inferred.q95:.2f} s"
    if inferred.seconds == 0.0:
        return f"No dead time is clear ({span}): T_L holds it. --dead-time sets one."
    return f"Dead time inferred, {inferred.seconds:.2f} s ({span}): T_L is the lag behind it. --dead-time sets another."


def late_note(late: LateChannel | None) -> str:
    """What was done about a late channel, in one sentence; empty where none is late."""
    if late is None:
        return ""
    other = "speed" if late.name == "accel" else "accel"
    done = f"{late.name} is moved by it" if late.recoverable else f"{late.name} is left out and {other} used alone"
    return f"{late}: {done}. --no-align leaves both as they are."


def estimates_note(answer: Mapping[str, Any]) -> str:
    """Summarise a list of windows in one sentence."""
    windows = answer["windows"]
    excited, used = ([w for w in windows if w[key]] for key in ("excited", "used"))
    if not excited:
        longer = "use a longer --window" if len(windows) > 1 else "drive with more acceleration and braking"
        return f"{len(windows)} windows, none excited: the belief is still the first prior; {longer}."
    lost = len(excited) - len(used)
    count = f"{len(excited)} of {len(windows)} windows excited"
    if lost:
        what = "their chains" if answer.get("estimator", "sgld") == "sgld" else "the estimates"
        count += f", {lost} of them not used, as {what} did not converge"
    if not used:
        return f"{count}; the belief is still the first prior."
    last = used[-1]
    text = ", ".join(f"{name} {last[name]['mean']:.3f} ± {last[name]['sd']:.3f}" for name in ("T_L", "K_L"))
    spread = [f"{name} {x:.1f}" for name, x in answer["spread_over_sd"].items() if x is not None]
    more = f" Spread from window to window over posterior SD: {', '.join(spread)}." if spread else ""
    if unexplained(answer["spread_over_sd"]):
        more += " Lag and gain alone do not explain this log, or they changed: find the cause with avtorch diagnose."
    elif all("accepted_change" in w["alerts"] for w in used):
        more += (
            " All of them differ from the accepted values: if the car is sound, pass its own with --accepted T_L,K_L."
        )
    return f"{count}; the last {'used' if lost else 'of them'} estimates {text}.{more}"
