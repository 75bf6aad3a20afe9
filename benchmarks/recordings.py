"""The recordings of ``AVTORCH_DATA`` that have commands, and several logs as one."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.io import Log

_BETWEEN_S = 5.0
SETS: dict[str, tuple[str, ...]] = {
    "genesis, three laps": ("genesis/lap1.csv", "genesis/lap2.csv", "genesis/lap3.csv"),
    "genesis, lap 1": ("genesis/lap1.csv",),
    "genesis, lap 2": ("genesis/lap2.csv",),
    "genesis, lap 3": ("genesis/lap3.csv",),
    "indy_av21": ("indy_av21/Putnam_park2023_run4_2.csv",),
    "roboracer, one mass": ("roboracer/Normal_1weight.csv",),
    "roboracer, other mass": ("roboracer/single_mass.csv",),
    "roboracer, tyres": ("roboracer/tire_set_1.csv",),
    "roboracer, training": ("roboracer/ftg_stanley_total_training.csv",),
    "roboracer, validation": ("roboracer/ftg_stanley_total_validation.csv",),
    "dart, 10:02": ("dart/09_16_2024_10_02_28_onboard10Hz.csv",),
    "dart, 10:27": ("dart/09_16_2024_10_27_02_onboard10Hz.csv",),
    "dart, 10:02, motion capture": ("dart/09_16_2024_10_02_28_vicon50Hz.csv",),
    "dart, 10:27, motion capture": ("dart/09_16_2024_10_27_02_vicon50Hz.csv",),
    "volvo_truck": ("volvo_truck/052311_grade.csv",),
}
"""Recordings with commands, by name: the logs of one car."""


def folder() -> Path:
    """Ends the process where it is not named."""
    found = os.environ.get("AVTORCH_DATA")
    if found is None:
        raise SystemExit("AVTORCH_DATA: not set, needs the folder of the recordings")
    return Path(found)


def joined(logs: Sequence[Log]) -> Log:
    """One log of several, each a segment, with some seconds between them."""
    if len(logs) == 1:
        return logs[0]
    ends = np.cumsum([0.0, *(log.seconds + _BETWEEN_S for log in logs)])
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(log, name) for log in logs])
        for name in ("accel_cmd", "speed", "accel", "engaged")
        if all(getattr(log, name, None) is not None for log in logs)
    }
    time = np.concatenate([log.elapsed - log.elapsed[0] + end for log, end in zip(logs, ends[:-1], strict=True)])
    segment = np.concatenate([np.full(log.rows, number) for number, log in enumerate(logs)])
    return Log.from_arrays(name=logs[0].name, time=time, segment=segment, **columns)
