"""Folds of the drives: blocks that are held out, and rows far enough from them to be fitted.

Every block is held out once. Rows beside a held-out block are excluded from the fit, as noise is correlated across the
boundary. The blocks of one fold are spread over the drive, so each fold covers early and late, slow and fast driving.
With three or more drives, none of them longer than half of all, whole drives are held out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from avtorch.arrays import BoolArray, IntArray
from avtorch.gap.drive_record import Record

FOLDS = 5
FEWEST_BLOCKS = 5
"""On either side of a comparison."""
_BLOCKS = 20  # of a long drive
_DRIVES = 3  # fewest drives for which whole ones are held out
_WHOLE_S = 10.0  # a block holds one to six of these, so that rollouts of this length fit in
_SHORTER_S = (8.0, 7.0, 6.0, 5.0, 4.0)  # tried in turn where a drive is too short for that


@dataclass(frozen=True, eq=False)
class Fold:
    """`fits`: the record to which parameters are fitted; `held_out`: the record that scores them, made of
    `blocks` (begin, end) of counted rows.
    """

    fits: Record = field(repr=False)
    held_out: Record = field(repr=False)
    blocks: tuple[slice, ...]

    @property
    def rows(self) -> NDArray[np.intp]:
        """Held-out rows, as counted rows of the whole record."""
        return np.concatenate([np.arange(b.start, b.stop) for b in self.blocks])


def folds(record: Record, *, apart_s: float = 3.0, parts: int = FOLDS) -> tuple[Fold, ...]:
    """The record's folds, `apart_s` [s] between fitted and held-out rows; empty where there is too little for two."""
    blocks = blocks_of(record)
    groups = whole_drive_folds(record, parts)
    if groups:
        numbers = _drive_of(record)
        each = [tuple(b for b in blocks if numbers[b.start] in group) for group in groups]
        return tuple(_part(record, own, apart_s) for own in each)
    count = min(parts, len(blocks))
    if count < 2:
        return ()
    return tuple(_part(record, tuple(blocks[k::count]), apart_s) for k in range(count))


def whole_drive_folds(record: Record, parts: int = FOLDS) -> list[set[int]]:
    """Numbers of the drives held out together, about equal shares of the rows; empty where there are too few drives."""
    sizes = np.bincount(_drive_of(record), minlength=len(record.segments))
    there = [int(k) for k in np.argsort(-sizes, kind="stable") if sizes[k] > 0]
    if len(there) < _DRIVES or sizes.max() > 0.5 * record.rows:
        return []
    groups: list[set[int]] = [set() for _ in range(min(parts, len(there)))]
    for number in there:
        least = min(groups, key=lambda g: sum(int(sizes[k]) for k in g))
        least.add(number)
    return groups


def _drive_of(record: Record) -> IntArray:
    """Segment number of each counted row."""
    each = 1 if record.coarse is record.drives else record.group
    ends = np.cumsum([len(d.time) * each // record.group for d in record.coarse])
    return np.asarray(record.segment)[np.searchsorted(ends, record.source, side="right")]


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


def _part(record: Record, blocks: tuple[slice, ...], apart_s: float) -> Fold:
    held_out: BoolArray = np.zeros(record.rows, bool)
    fits: BoolArray = np.ones(record.rows, bool)
    apart = round(apart_s / record.dt)
    for block in blocks:
        held_out[block] = True
        near = slice(max(block.start - apart, 0), block.stop + apart)
        fits[near] &= record.stretch[near] != record.stretch[block.start]
    return Fold(record.only(fits), record.only(held_out), blocks)
