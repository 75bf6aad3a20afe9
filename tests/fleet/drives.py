"""Small drives of simulated cars for the tests of fleets."""

from __future__ import annotations

from pathlib import Path

import avtorch
from avtorch.fleet import FleetSettings
from avtorch.io import Log

QUICK = FleetSettings(steps=("check", "estimate"), estimator="map", dead_time=0.0)
"""What a test needs of a log in some hundredths of a second."""


def drive(lag: float = 0.4, gain: float = 0.9, *, seconds: float = 8.0, start: float = 50.0) -> Log:
    """A drive of a car without noise behind the default leader, 20 Hz."""
    leader = avtorch.Leader.default(start=start, duration=seconds, dt=0.05)
    return avtorch.simulate(leader, plant=avtorch.GLVDPlant(lag, gain)).log()


def write_fleet(folder: Path, lags: dict[str, float]) -> list[Path]:
    """`folder/CAR/drive.csv` for each car."""
    paths = []
    for car, lag in lags.items():
        path = folder / car / "drive.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        drive(lag).write(path)
        paths.append(path)
    return paths
