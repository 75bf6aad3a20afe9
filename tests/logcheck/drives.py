"""A drive of a known car, by its own difference equation, and rows of it as text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

Columns = dict[str, np.ndarray]
LAG_S, GAIN = 0.3, 0.95


def drive(seed: int, seconds: float = 60.0, rate: float = 50.0) -> Columns:
    """A car with a lag of 0.3 s and a gain of 0.95, and sensors with noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    phase = rng.uniform(0, 2 * np.pi, 4)
    command = sum(
        0.5 * np.sin(2 * np.pi * f * time + p) for f, p in zip((0.05, 0.11, 0.23, 0.41), phase, strict=True)
    ) + np.zeros(len(time))
    accel = np.zeros(len(time))
    for i in range(len(time) - 1):
        accel[i + 1] = accel[i] + (GAIN * command[i] - accel[i]) / (LAG_S * rate)
    speed = 20 + np.concatenate([[0.0], np.cumsum(accel[:-1])]) / rate
    return {
        "time": time,
        "accel_cmd": command,
        "accel": accel + 0.03 * rng.standard_normal(len(time)),
        "speed": speed + 0.02 * rng.standard_normal(len(time)),
    }


def written(path: Path, columns: Mapping[str, Iterable[object]], *, before: str = "") -> Path:
    """The columns as text, numbers in full; `before`: lines before the header."""
    cells = (values.tolist() if isinstance(values, np.ndarray) else values for values in columns.values())
    rows = zip(*cells, strict=True)
    path.write_text(
        before + "\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]), encoding="utf-8"
    )
    return path
