"""Every recording with commands of `AVTORCH_DATA` that a diagnosis can read, at most five minutes of each.

What has no `accel_cmd` is read through a map of its pedals, as the command line does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from avtorch import diagnose
from avtorch.io import Log, fingerprint
from avtorch.pedals import fit_pedals
from benchmarks.golden.facts import Answer, diagnosis_facts, timed
from benchmarks.recordings import SETS, folder

MOST_S = 300.0
FILES: dict[str, tuple[str, ...]] = {
    **SETS,
    "dart, march": ("dart/mpcc_7march.csv",),
    "cpm_lab_ucar": ("cpm_lab_ucar/run.csv",),
    "f110_frictionmaps": ("f110_frictionmaps/ds5.csv",),
}


def first(log: Log, seconds: float) -> Log:
    """Its first `seconds`."""
    return log[slice(0, int(np.searchsorted(log.elapsed - log.elapsed[0], seconds)))]


def cases() -> Iterator[tuple[str, Callable[[], Answer]]]:
    for name, files in FILES.items():
        yield f"recordings/{name}", lambda files=files: answered(files)


def answered(files: tuple[str, ...]) -> Answer:
    logs = [first(Log.read(folder() / file), MOST_S) for file in files]
    by = None
    if any(log.accel_cmd is None for log in logs):
        fit = fit_pedals(logs)
        by, logs = list(fit.map.pedals), [fit.map.commanded(log) for log in logs]
    found, took = timed(lambda: diagnose(logs, progress=False))
    kept: Answer = {
        "drive": f"{sum(log.seconds for log in logs):.0f} s at {logs[0].rate_hz:.0f} Hz",
        "log": fingerprint([[log.time, log.accel_cmd, log.accel, log.speed] for log in logs])[:12],
    }
    return kept | ({} if by is None else {"commands_by": by}) | diagnosis_facts(found.to_dict()) | took
