"""What each effect is mistaken for: `python -m benchmarks.mistaken`, some five minutes of one core.

Each effect at its default size drives a car of T_L 0.30 s and K_L 1 behind the default leader, for two minutes at 20 Hz
with a jerk noise of 0.1 m/s³. The log is diagnosed with all effects, and once more with all others: what is then named,
and how many nats it explains less, is what the effect is mistaken for where it is not among the hypotheses.
"""

from __future__ import annotations

from avtorch import Diagnosis, Leader, diagnose, simulate
from avtorch.gap import EFFECTS, plant

SECONDS, DT, SIGMA = 120.0, 0.05, 0.1


def row(name: str) -> str:
    """The effect's row of the table."""
    car = plant([EFFECTS[name]()], sigma=SIGMA)
    log = simulate(Leader.default(start=30.0, duration=SECONDS, dt=DT), plant=car).log()
    found = diagnose(log, pairs=False)
    without = diagnose(log, effects=[other for other in EFFECTS if other != name], pairs=False)
    best = found.winner.log_evidence if found.verdict.name == name else evidence(found, name)
    rivals = {c.name: c.log_evidence for c in without.candidates if c.log_evidence is not None and c.name != "none"}
    nearest = sorted(rivals, key=lambda name: -rivals[name])[:2]
    next_best = [] if best is None else [f"{other} ({rivals[other] - best:+.0f})" for other in nearest]
    base = found.baseline
    cells = (
        name,
        "itself" if found.verdict.alias_set == (name,) else named(found),
        "" if best is None else f"{best:.0f}",
        f"{base['T_L'].mean:.2f}, {base['K_L'].mean:.2f}",
        named(without),
        ", ".join(next_best),
    )
    return f"| {' | '.join(cells)} |"


def evidence(found: Diagnosis, name: str) -> float | None:
    return next((c.log_evidence for c in found.candidates if c.name == name), None)


def named(found: Diagnosis) -> str:
    """The verdict, and what the log cannot distinguish from it."""
    others = [x for x in found.verdict.alias_set if x != found.verdict.name]
    return found.verdict.name + (f", or {', '.join(others)}" if others else "")


def main() -> None:
    titles = ("effect", "named", "its nats over none", "T_L [s], K_L without it", "where it is not in the table")
    print(f"| {' | '.join((*titles, 'nearest single effects (nats against the truth)'))} |")
    print("|---|---|---|---|---|---|")
    for name in sorted(EFFECTS):
        print(row(name), flush=True)


if __name__ == "__main__":
    main()
