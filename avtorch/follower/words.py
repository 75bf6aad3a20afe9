"""A follower's diagnosis in words: one or two sentences on each property of the loop."""

from __future__ import annotations

from avtorch.follower.diagnose_follower import FollowerDiagnosis
from avtorch.gap.quantity import Quantity

_SPOKEN = {"constant_time_gap": "a constant time gap", "intelligent_driver": "the Intelligent Driver Model"}


def loop_lines(found: FollowerDiagnosis) -> list[str]:
    """Law, headway, lag with delay, string stability, and how well the closed loop does."""
    q, usual = found.parameters, found.usual
    own, bare = found.loops[found.law.name], found.loops["without_delay"]
    peak = "" if usual.peak_gain is None else f", peak gain {_formatted(usual.peak_gain, '')}"
    rivals = [x for name, x in found.loops.items() if name not in (found.law.name, "without_delay")]
    other = f" (the other law: {rivals[0].speed:.2g} m/s)" if rivals else ""
    return [
        f"Assuming {_SPOKEN[found.law.name]}: headway {_formatted(q['headway_s'], ' s')} at {usual.speed:.0f} m/s, "
        f"lag with delay {_formatted(q['lag_with_delay_s'], ' s')}.",
        f"P(string stable) is {usual.p_string_stable:.2f} at {usual.speed:.0f} m/s{peak}. Over a minute the car "
        f"amplified its leader's speed variation {own.amplified:.2f} times; the simulated loop does "
        f"{own.amplified_simulated:.2f} times.",
        f"Driven by the leader alone over a held-out minute, the loop errs by {own.speed:.2g} m/s and "
        f"{own.spacing:.2g} m{other}; without a dead time by {bare.speed:.2g} m/s and {bare.spacing:.2g} m, and a car "
        f"at constant speed by {found.keeps_speed:.2g} m/s.",
    ]


def _formatted(q: Quantity, unit: str) -> str:
    return f"{q.mean:.2f}{unit} ({q.q05:.2f} to {q.q95:.2f})"
