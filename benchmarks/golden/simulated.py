"""Forty simulated logs: twenty cases of the blind test, each behind the ideal and behind an ordinary recorder."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from avtorch import diagnose
from avtorch.io import fingerprint
from benchmarks.blindtest import EFFECTS, Case, draw_case
from benchmarks.golden.facts import Answer, diagnosis_facts, timed

SEED = 20265001
"""Of a set that nothing else draws from."""
NUMBER = 20
MIX = {"none": 0.2, "single": 0.35, "pair": 0.15, "outside": 0.15, "several": 0.15}
SECONDS = (60.0, 120.0, 300.0)
"""Lengths of the drives, by turns [s]."""
DRAWN = tuple(name for name in EFFECTS if name not in ("hand_over", "viscous_drag", "speed_lag"))
"""Causes of the set: those of the table when it was first drawn."""


def cases() -> Iterator[tuple[str, Callable[[], Answer]]]:
    for recorder in ("ideal", "ordinary"):
        for index in range(NUMBER):
            yield f"simulated/{recorder}/{index:02d}", lambda i=index, r=recorder: answered(i, r)


def answered(index: int, recorder: str) -> Answer:
    seconds = SECONDS[index % len(SECONDS)]
    case = draw_case(index, SEED, mix=MIX, seconds=seconds, recorder=recorder, effects=DRAWN)  # type: ignore[arg-type]
    log = case.log()
    found, took = timed(lambda: diagnose(log, progress=False))
    answer = found.to_dict()
    true = truth(case)
    name = "+".join(sorted(true["names"]))
    probability = next((e["probability"] for e in answer["effects"] if e["name"] == name), 0.0)
    return {
        "truth": true,
        "drive": f"{case.drive.manoeuvre}, {case.drive.seconds:g} s at {case.drive.rate_hz} Hz",
        "log": fingerprint(log.time, log.accel_cmd, log.accel, log.speed)[:12],
        **diagnosis_facts(answer),
        "p_truth": probability,
        **took,
    }


def truth(case: Case) -> Answer:
    whole = case.truth()
    names = whole["verdict"].split("+") if whole["verdict"] else []
    # several causes that are all outside the table
    kept: Answer = {"names": names or ["unknown"], "kind": case.kind, "tier": case.tier, "onset_s": case.onset_s}
    outside = [name for name in case.names if name not in names]
    return kept | {"outside": outside, "parameters": whole["parameters"], "baseline": whole["baseline"]}
