"""Recorded drives of one unchanged car: every alarm is a false one, whatever effects the model lacks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from avtorch.decision import Monitor, Setting, estimate
from avtorch.decision.monitor import DETECTORS
from avtorch.inference.sequential import Belief
from avtorch.io import Log

# A log does not contain its controller, so the stability of the loop is not evaluated.
JUDGED = tuple(name for name in DETECTORS if name != "stability")


def alarmed(beliefs: Sequence[Belief], unevenness: tuple[float, float]) -> dict[str, int]:
    """Windows with an alarm, by detector, each alone and at its default, over the beliefs of one car in order."""
    out = {}
    for name in JUDGED:
        monitor, count = Monitor(1, detectors=[name], unevenness=unevenness), 0
        for belief in beliefs:
            T, K = (belief.draws[..., i].mT for i in range(2))
            report = monitor.update(T, K, belief.excited & belief.converged, Setting())
            count += int(report.any[0])
        out[name] = count
    return out


def judge(paths: Sequence[Path], unevenness: tuple[float, float], *, window: float = 10.0) -> None:
    """Print every detector's alarms on drives `paths` of one car, with and without `unevenness`."""
    torch.set_num_threads(1)
    beliefs = []
    for path in paths:
        found = [w.window.belief for w in estimate(Log.read(path), window=window).windows]
        used = [b for b in found if bool(b.excited[0] & b.converged[0])]
        estimates = ", ".join(f"{b.stat('T_L')['mean']:.2f} s / {b.stat('K_L')['mean']:.2f}" for b in used)
        print(f"{path.name}: {len(used)} of {len(found)} windows of {window:g} s used: {estimates}")
        beliefs += used
    for granted in ((0.0, 0.0), unevenness):
        counts = alarmed(beliefs, granted)
        print(f"windows with an alarm of {len(beliefs)}, unevenness {granted}: "
              + ", ".join(f"{name} {count}" for name, count in counts.items()))  # fmt: skip
