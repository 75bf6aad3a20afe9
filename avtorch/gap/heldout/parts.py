"""How drives are parted: blocks that judge, and what lies far enough from them to fit.

Every block judges once. Rows beside a block are left out of the fit that it judges, as far as what chance did to the
one is still felt in the other. Blocks of one part lie all over the drive, so that each part sees early and late, slow
and fast.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.likelihood.record import Record

Rows = NDArray[np.bool_]

PARTS = 5
_BLOCKS = 20  # of a long drive
_WHOLE_S = 10.0  # of which a block has one to six: rollouts of that length have to fit in


@dataclass(frozen=True, eq=False)
class Part:
    """`fits`: what parameters are fitted to; `blocks` (begin, end) among the record's counted rows judge them."""

    fits: Record = field(repr=False)
    judges: Record = field(repr=False)
    blocks: tuple[slice, ...]

    @property
    def rows(self) -> NDArray[np.intp]:
        """Counted rows of the whole record that judge."""
        return np.concatenate([np.arange(b.start, b.stop) for b in self.blocks])


def parted(record: Record, *, apart_s: float = 3.0, parts: int = PARTS) -> tuple[Part, ...]:
    """The record's parts, `apart_s` [s] between what fits and what judges; none where there is too little for two."""
    blocks = blocks_of(record)
    count = min(parts, len(blocks))
    if count < 2:
        return ()
    return tuple(_part(record, tuple(blocks[k::count]), apart_s) for k in range(count))


def blocks_of(record: Record) -> list[slice]:
    """Every counted row in one block, of 10 to 60 s; short stretches are blocks of their own."""
    return list(_blocks(record))


def _blocks(record: Record) -> Iterator[slice]:
    seconds = _WHOLE_S * float(np.clip(round(record.rows * record.dt / _BLOCKS / _WHOLE_S), 1, 6))
    for begin, end in pairwise([*record.starts.tolist(), record.rows]):
        count = max(1, int((end - begin) * record.dt / seconds + 1e-9))
        edges = np.linspace(begin, end, count + 1).round().astype(int).tolist()
        yield from (slice(a, b) for a, b in pairwise(edges))


def _part(record: Record, blocks: tuple[slice, ...], apart_s: float) -> Part:
    judges: Rows = np.zeros(record.rows, bool)
    fits: Rows = np.ones(record.rows, bool)
    apart = round(apart_s / record.dt)
    for block in blocks:
        judges[block] = True
        near = slice(max(block.start - apart, 0), block.stop + apart)
        fits[near] &= record.stretch[near] != record.stretch[block.start]
    return Part(record.only(fits), record.only(judges), blocks)
