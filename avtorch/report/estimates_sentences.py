"""What an estimate says, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.decision.dead_time import InferredDeadTime
    from avtorch.logcheck.late_channel import LateChannel

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
