"""Delay against false alarms: all detectors on the same beliefs, many runs with and without a change.

``python -m benchmarks.detectors [--runs 200] [--leader FILE --vehicle N --start S] [--out DIR]``
``python -m benchmarks.detectors --logs DRIVE ...``: recorded drives of one unchanged car

Unchanged runs: `healthy`, the vehicle as accepted (0.3 s, 1.0); `rough`, with three times the jerk noise; `off`, a
sound vehicle of (0.35 s, 0.95); `uneven`, whose gain swings by 2 % over half a minute. Changes, at a random moment
between 40 and 120 s: `abrupt` to (1.5 s, 0.5), `drift` there over 60 s, `moderate` to (0.45 s, 0.85), `slight` to
(0.36 s, 0.95).

Three pairs of tables: every detector at its default; at the most sensitive setting that alarms in at most 1 % of
healthy runs, chosen behind US06 on separate seeds; and at its default again, with an `unevenness` of 10 % in T_L and
3 % in K_L allowed for the vehicle (`Monitor`), which only divergences and charts use. No run in a table was used to
choose.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import torch

from avtorch.vehicle import Leader, stability
from benchmarks.detectors.drives import CHANGES, HEALTHY, UNCHANGED, Beliefs, Change, drive
from benchmarks.detectors.judge import DETECTORS, scores
from benchmarks.detectors.recorded import judge
from benchmarks.detectors.tables import DEFAULT, Scores, alarms, chosen, curve, delays, rows, times

QUIET_SHARE = 0.01
CHOOSING_SEED, JUDGING_SEED = 500_000, 2_000_000
UNEVENNESS = (0.1, 0.03)


def lost_after(change: Change) -> float:
    """When the drifting vehicle ceases to be string stable under the default setting [s after the drift began]."""
    share = torch.linspace(0.0, 1.0, 6001, dtype=torch.float64)
    T, K = (old + share * (new - old) for old, new in zip(HEALTHY, change.to, strict=True))
    stable = stability.string_stable(T, K, 1.0, (1.5, 1.5, -0.8))
    return float(share[~stable][0]) * change.ramp_s


def collect(
    leader: Leader, kinds: Mapping[str, Change], *, runs: int, first_seed: int, duration: float
) -> dict[str, tuple[Beliefs, Scores]]:
    """Beliefs and scores by kind of run; each kind has seeds of its own."""
    out = {}
    for k, (name, change) in enumerate(kinds.items()):
        print(f"  {leader.name}: {runs} runs of {duration:g} s, {name}", file=sys.stderr, flush=True)
        beliefs = drive(leader, change, runs=runs, first_seed=first_seed + 10_000 * k, duration=duration)
        out[name] = (beliefs, scores(beliefs))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200, help="runs of each kind")
    parser.add_argument("--duration", type=float, default=240.0, help="of a run [s]")
    parser.add_argument("--leader", type=Path, help="a recorded leader; by default US06")
    parser.add_argument("--vehicle", type=int, help="which vehicle of the recording")
    parser.add_argument("--start", type=float, default=0.0, help="second of the recording to begin at")
    parser.add_argument("--out", type=Path, help="folder for detectors.json and detectors.png")
    parser.add_argument(
        "--logs", type=Path, nargs="+", help="drives of one car, with accel_cmd, in place of simulated runs"
    )
    options = parser.parse_args()
    if options.logs is not None:
        judge(options.logs, UNEVENNESS)
        return
    torch.set_num_threads(1)
    how = {"runs": options.runs, "duration": options.duration}
    if options.leader is None:
        leader = Leader.default(start=options.start)
    else:
        leader = Leader.read(options.leader, vehicle=options.vehicle, start=options.start)
    choosing = collect(Leader.default(), {"healthy": UNCHANGED["healthy"]}, first_seed=CHOOSING_SEED, **how)
    kept = collect(leader, {**UNCHANGED, **CHANGES}, first_seed=JUDGING_SEED, **how)
    tolerant = {kind: (beliefs, scores(beliefs, UNEVENNESS)) for kind, (beliefs, _) in kept.items()}
    plain = {name: detector.default for name, detector in DETECTORS.items()}
    parts = {
        "at the defaults": (kept, plain),
        "quiet on healthy runs": (kept, chosen(choosing, QUIET_SHARE)),
        "at the defaults, unevenness granted": (tolerant, plain),
    }
    kinds = list(UNCHANGED), list(CHANGES)
    tables = {title: rows(runs, values, *kinds) for title, (runs, values) in parts.items()}
    used = {kind: f"{100 * float(b.used.double().mean()):.0f} %" for kind, (b, _) in kept.items()}
    print(f"{leader.name}, start {options.start:g} s: {options.runs} runs of {options.duration:g} s of each kind")
    print("windows used: " + ", ".join(f"{kind} {share}" for kind, share in used.items()))
    print("collided runs: " + ", ".join(f"{kind} {b.collided}" for kind, (b, _) in kept.items()))
    for title, table in tables.items():
        print(f"\n## {title}\n\n{alarms(table, kinds[0])}\n\n{delays(table, kinds[1])}")
    turn = lost_after(CHANGES["drift"])
    print(f"\ndrift: string stability is lost {turn:.1f} s after it began; share of runs alarmed by then")
    beliefs = kept["drift"][0]
    for title, (runs, values) in parts.items():
        first = times(runs["drift"][1], beliefs, values)
        shares = []
        for name, t in first.items():
            early = (t > beliefs.change_s) & (t - beliefs.change_s <= turn)
            shares.append(f"{name} {100 * float(early.double().mean()):.0f} %")
        print(f"  {title}: " + ", ".join(shares))
    if options.out is not None:
        curves = {
            "healthy runs": (kept, "healthy"),
            "uneven runs": (kept, "uneven"),
            "uneven runs, granted": (tolerant, "uneven"),
        }
        drawn = {title: {n: curve(n, r[kind], r["drift"]) for n in DETECTORS} for title, (r, kind) in curves.items()}
        write(options.out, {"leader": leader.name, "tables": tables, "curves": drawn, "default": DEFAULT})


def write(out: Path, answer: dict[str, object]) -> None:
    """The figures as JSON, and the operating curves drawn."""
    from avtorch.plots import save
    from benchmarks.detectors.tables import operating_figure

    out.mkdir(parents=True, exist_ok=True)
    (out / "detectors.json").write_text(json.dumps(answer, indent=1, default=str) + "\n", encoding="utf-8")
    save(operating_figure(answer["curves"]), out / "detectors.png")


if __name__ == "__main__":
    main()
