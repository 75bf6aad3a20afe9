"""Facts of the diagnosed log: rows, rate, signals, and the ranges of speed and command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.gap.quantity import of_fields
from avtorch.io import Log

SIGNALS = ("accel_cmd", "accel", "speed", "jerk", "spacing", "lead_speed", "lead_accel", "grade")


@dataclass(frozen=True)
class LogFacts:
    """Facts of the logs: all `rows`, usable or not; `seconds` without gaps; `signals` in any of the logs.

    `name`: the logs' own; files without their folders, which a reader of the answer need not know. Over counted rows:
    `speeds` [m/s] without the slowest and the fastest hundredth, `commands` [m/s²] in full; None: not logged.
    `epochs_s`: start of each log, on its own clock [s].
    """

    rows: int
    segments: int
    seconds: float
    rate_hz: float
    signals: tuple[str, ...] = ()
    name: str = "log"
    speeds: tuple[float, float] | None = None
    commands: tuple[float, float] | None = None
    epochs_s: tuple[float, ...] = (0.0,)

    @classmethod
    def of(cls, logs: Log | Sequence[Log]) -> LogFacts:
        """The facts of one log, or of several drives of one car; the rate is then their mean by time."""
        all_ = [logs] if isinstance(logs, Log) else list(logs)
        seconds = math.fsum(log.seconds for log in all_)
        return cls(
            rows=sum(log.rows for log in all_),
            segments=sum(len(log.segments()) for log in all_),
            seconds=seconds,
            rate_hz=math.fsum(log.rate_hz * log.seconds for log in all_) / seconds,
            signals=tuple(name for name in SIGNALS if any(getattr(log, name) is not None for log in all_)),
            name=", ".join(Path(log.name).name or log.name for log in all_),
            speeds=_driven(all_, "speed", 0.01),
            commands=_driven(all_, "accel_cmd", 0.0),
            epochs_s=tuple(log.epoch_s for log in all_),
        )

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        return out | {"speeds_mps": out.pop("speeds"), "commands_mps2": out.pop("commands")}


def _driven(logs: Sequence[Log], signal: str, apart: float) -> tuple[float, float] | None:
    """Range of a signal over its usable rows, without a share `apart` of them at either end."""
    rows = [values[log.usable] for log in logs if (values := getattr(log, signal)) is not None]
    joined = np.concatenate(rows) if rows else np.zeros(0)
    if not len(joined):
        return None
    low, high = np.quantile(joined, (apart, 1 - apart))
    return float(low), float(high)
