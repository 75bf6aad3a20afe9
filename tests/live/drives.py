"""Rows of simulated cars, as a live source would send them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import torch

from avtorch import GLVDPlant, Leader, simulate

STEP_S = 0.02


@cache
def drive(lag: float, gain: float, seconds: float = 12.0, seed: int = 0) -> tuple[dict[str, Any], ...]:
    """Rows of a car at 50 Hz, behind the paper's leader, with measured jerk."""
    ahead = Leader.default(start=60.0, duration=seconds, dt=STEP_S)
    run = simulate(ahead, plant=GLVDPlant(lag, gain, sigma=0.1), seeds=[seed])
    names = ("accel_cmd", "accel", "speed", "jerk")
    columns = torch.stack([run.time, *(getattr(run, name).flatten() for name in names)]).T
    return tuple({k: round(v, 6) for k, v in zip(("time", *names), row, strict=True)} for row in columns.tolist())


CARS = {"red": (0.3, 1.0), "blue": (1.5, 0.5), "green": (0.4, 0.9)}


def fleet(seconds: float = 12.0, cars: dict[str, tuple[float, float]] | None = None) -> list[dict[str, Any]]:
    """Rows of several cars, one after the other at each moment, each on a clock of its own."""
    drives = {car: drive(*actuation, seconds, seed) for seed, (car, actuation) in enumerate((cars or CARS).items())}
    rows = []
    for i in range(len(next(iter(drives.values())))):
        for k, (car, own) in enumerate(drives.items()):
            rows.append({"car": car, **own[i], "time": round(own[i]["time"] + 1000.37 * k, 6)})
    return rows


def lines(rows: list[dict[str, Any]]) -> bytes:
    return "".join(json.dumps(row) + "\n" for row in rows).encode()


def until(what: Callable[[], object]) -> None:
    """Wait until `what` gives something; the bar is for a machine with other work."""
    end = time.monotonic() + 60
    while not what():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
