"""A drive whose signals agree with each other, for the tests of this folder to break."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def drive(seconds: float = 30.0, rate: float = 50.0, lag: float = 0.3, noise: float = 0.0, seed: int = 0) -> dict:
    """Columns of a good log: a command of three tones, the acceleration following it by ``lag`` [s], its integral."""
    rng = np.random.default_rng(seed)
    n = round(seconds * rate)
    time = np.arange(n) / rate
    command = 0.8 * np.sin(0.9 * time) + 0.5 * np.sin(2.1 * time + 1) + 0.3 * np.sin(0.35 * time)
    keep = np.exp(-1 / (rate * lag))
    accel = np.zeros(n)
    for i in range(n - 1):
        accel[i + 1] = keep * accel[i] + (1 - keep) * command[i]
    speed = 15 + np.concatenate([[0.0], np.cumsum(0.5 * (accel[1:] + accel[:-1]))]) / rate
    return {
        "time": time,
        "accel_cmd": command,
        "accel": accel + noise * rng.standard_normal(n),
        "speed": speed + noise * rng.standard_normal(n),
    }


def write(path: Path, columns: dict, separator: str = ",") -> Path:
    """The columns as text, every number in full."""
    rows = zip(
        *([v if isinstance(v, str) else repr(float(v)) for v in values] for values in columns.values()), strict=True
    )
    lines = [separator.join(columns), *(separator.join(row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def with_cell(columns: dict, column: str, row: int, cell: object) -> dict:
    """The columns with one cell (``row`` counts from 1) replaced by ``cell``, text or number."""
    changed = {name: list(values) for name, values in columns.items()}
    changed[column][row - 1] = cell
    return changed
