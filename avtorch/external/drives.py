"""The drives of a log: what a simulator goes through in one go, beginning where the car begins.

A car begins anew at each segment, where the driver lets go, and at each start from standstill. At rest a brake holds it
whatever the command says, and a car and its simulator stop at different moments, so rows in which either stands do not
count.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from avtorch.io import Log


def drives_of(log: Log) -> list[slice]:
    """Rows of `log` that a simulator drives in one go."""
    out = []
    for part in log.engaged_segments():
        starts = [part.start]
        if log.speed is not None:
            stands = log.speed[part] < log.standstill_mps
            starts += [part.start + int(k) for k in np.flatnonzero(np.diff(stands.astype(int)) == -1)]
        edges = [*dict.fromkeys(starts), part.stop]
        out += [slice(a, b) for a, b in pairwise(edges) if b - a > 1]
    return out


def in_drives(simulated: Log, log: Log) -> Log:
    """The simulator's output, in the rows of the car's `log`, with a segment for each of the car's drives.

    Rows in which either stands are not `engaged`.
    """
    edges = np.zeros(log.rows + 1, dtype=np.int64)
    for part in drives_of(log):
        edges[[part.start, part.stop]] = 1
    edges[1:-1] |= np.diff(log.segment) != 0
    segment = np.cumsum(edges[:-1]) - edges[0]
    return replace(simulated, segment=segment, engaged=simulated.engaged & log.moving & simulated.moving)
