"""Every counted row lies in one block, within one stretch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avtorch.gap.drive_record import FEWEST_BLOCKS, Record, blocks_of
from tests.gap.records import log_of


@pytest.mark.parametrize("rate_hz", [20, 50])
@pytest.mark.parametrize("seconds", [40.0, 130.0, 300.0])
def test_every_row_is_in_one_block(seconds: float, rate_hz: int) -> None:
    log = log_of(seconds=seconds, rate_hz=rate_hz)
    record = Record.of(replace(log, engaged=(log.time < 20) | (log.time > 24)))
    blocks = blocks_of(record)
    np.testing.assert_array_equal(np.concatenate([np.arange(b.start, b.stop) for b in blocks]), np.arange(record.rows))
    for block in blocks:
        assert len(set(record.stretch[block].tolist())) == 1
        assert (block.stop - block.start) * record.dt > 9.9


def test_a_short_drive_has_shorter_blocks() -> None:
    record = Record.of(log_of(seconds=27.0))
    assert len(blocks_of(record)) == 2
    blocks = blocks_of(record, fewest=FEWEST_BLOCKS)
    assert len(blocks) == FEWEST_BLOCKS
    assert min(b.stop - b.start for b in blocks) * record.dt >= 4.0
