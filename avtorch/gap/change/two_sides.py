"""Two sets of drives as one record, before and after a change, with the side of every row and block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avtorch.arrays import BoolArray, FloatArray
from avtorch.errors import InputError
from avtorch.gap.blocks import FEWEST_BLOCKS
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.io import Log

_BLOCKS = 12  # aimed at on the shorter side, within these lengths
_SHORTEST_BLOCK_S, _LONGEST_BLOCK_S = 4.0, 10.0


@dataclass(frozen=True, eq=False)
class TwoSides:
    """`whole` has the stretches of both sides, those of `before` first; `is_after` (row,) tells the sides apart."""

    whole: AnalysisRecord
    before: AnalysisRecord
    after: AnalysisRecord
    is_after: BoolArray

    @classmethod
    def of(cls, before: Sequence[Log], after: Sequence[Log]) -> TwoSides:
        """Raises `InputError` where a side has less than five blocks of four seconds, or no channel is common."""
        usable = [sum(float(log.usable.sum()) / log.rate_hz for log in side) for side in (before, after)]
        seconds = float(np.clip(min(usable) / _BLOCKS, _SHORTEST_BLOCK_S, _LONGEST_BLOCK_S))
        whole = AnalysisRecord.of([*before, *after], block_s=seconds)
        is_after = whole.log >= len(before)
        sides = cls(whole, _part(whole, is_after, False), _part(whole, is_after, True), is_after)
        for name, after_side in (("before", False), ("after", True)):
            count = int((sides.block_is_after == after_side).sum())
            if count < FEWEST_BLOCKS:
                raise InputError(
                    f"{name}: found {count} blocks of {seconds:.3g} s of usable driving, needs {FEWEST_BLOCKS} or more"
                )
        return sides

    @property
    def block_is_after(self) -> BoolArray:
        """(block,)"""
        there = self.whole.block >= 0
        out = np.zeros(self.whole.blocks, bool)
        out[self.whole.block[there]] = self.is_after[there]
        return out

    def second_half(self, after: bool) -> FloatArray:
        """(row,): 1 in the later half of the blocks of one side, else 0."""
        own = np.nonzero(self.block_is_after == after)[0]
        later = self.whole.block >= own[len(own) // 2]
        return (later & (self.is_after == after)).astype(float)


def _part(whole: AnalysisRecord, is_after: BoolArray, after: bool) -> AnalysisRecord:
    """The record of one side, its rows counted from its own beginning."""
    rows = is_after == after
    first = int(np.argmax(rows))
    own = [s for s in whole.stretches if is_after[s.rows.start] == after]
    return replace(
        whole,
        stretches=tuple(replace(s, rows=slice(s.rows.start - first, s.rows.stop - first)) for s in own),
        **{name: getattr(whole, name)[..., rows] for name in ("measured", "counts", "block", "time", "log")},
        command=whole.command[rows],
        speed=whole.speed[rows],
    )
