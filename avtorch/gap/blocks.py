"""Blocks of the drives, by which errors are scored and their spread is estimated."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from avtorch.gap.drive_record import Record

FEWEST_BLOCKS = 5
"""On either side of a comparison."""
_BLOCKS = 20  # of a long drive
_WHOLE_S = 10.0  # a block holds one to six of these, so that rollouts of this length fit in
_SHORTER_S = (8.0, 7.0, 6.0, 5.0, 4.0)  # tried in turn where a drive is too short for that


def blocks_of(record: Record, *, fewest: int = 0) -> list[slice]:
    """A partition of the counted rows into blocks of 10 to 60 s; short stretches are blocks of their own.

    Where these are not `fewest`, blocks as short as 4 s.
    """
    blocks: list[slice] = []
    for whole_s in (_WHOLE_S, *_SHORTER_S):
        blocks = list(_blocks(record, whole_s))
        if len(blocks) >= fewest:
            break
    return blocks


def _blocks(record: Record, whole_s: float) -> Iterator[slice]:
    seconds = whole_s * float(np.clip(round(record.rows * record.dt / _BLOCKS / whole_s), 1, 6))
    for begin, end in pairwise([*record.starts.tolist(), record.rows]):
        count = max(1, int((end - begin) * record.dt / seconds + 1e-9))
        edges = np.linspace(begin, end, count + 1).round().astype(int).tolist()
        yield from (slice(a, b) for a, b in pairwise(edges))
