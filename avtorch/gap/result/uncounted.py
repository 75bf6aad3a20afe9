"""The stretches of a drive that did not count, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from avtorch.gap.result.counted_rows import CountedRows
from avtorch.io import Log

Reason = Literal["driver", "standstill", "gap", "settling"]
_REASONS: tuple[Reason, ...] = ("driver", "standstill", "settling")


@dataclass(frozen=True)
class Uncounted:
    """From `begin` to `end` [s from the start of its log] nothing counted, because of `why`; `log`: which of the logs
    that have rows that count, from 0.

    "driver": the command was not in force; "standstill"; "gap": no rows; "settling": the first seconds of a drive and
    of each return to the command, whose state is not known, and pieces too short to count.
    """

    begin: float
    end: float
    why: Reason
    log: int = 0


def uncounted(logs: Sequence[Log], record: CountedRows) -> tuple[Uncounted, ...]:
    """What `record`, made of these `logs`, does not count, in order of time."""
    found: list[Uncounted] = []
    for number, counted in enumerate(np.unique(record.log[record.source]).tolist()):
        log = logs[counted]
        own = record.source[record.log[record.source] == counted]
        why = np.full(log.rows, _REASONS.index("settling"))
        # averaged rows: from the stamp of the first of each to the next
        last = np.searchsorted(record.time[own], log.elapsed + 1e-6 * record.dt, side="right") - 1
        why[(last >= 0) & (log.elapsed - record.time[own][last] < (1 - 1e-3) * record.dt)] = -1
        why[(why >= 0) & ~log.moving] = _REASONS.index("standstill")
        why[(why >= 0) & ~log.engaged] = _REASONS.index("driver")
        for part, after in pairwise([*log.segments(), None]):
            assert part is not None
            edges = [part.start, *(np.flatnonzero(np.diff(why[part])) + 1 + part.start).tolist(), part.stop]
            for a, b in pairwise(edges):
                if why[a] >= 0:
                    end = log.elapsed[min(b, part.stop - 1)]
                    found.append(Uncounted(float(log.elapsed[a]), float(end), _REASONS[why[a]], number))
            if after is not None:
                ends = float(log.elapsed[part.stop - 1]), float(log.elapsed[after.start])
                if ends[1] - ends[0] > 2 * record.dt:
                    found.append(Uncounted(*ends, "gap", number))
    return tuple(found)
