"""The floor: an answer that does not use the drive."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np

from avtorch.gap import EFFECTS
from avtorch.io import Log
from benchmarks.blindtest.reply import reply

SHARES = {"none": 0.25, "single": 0.40, "pair": 0.20, "unknown": 0.15}
"""Shares of the kinds of cases, which is all that is known without the drive."""


def random_guess(log: Log) -> dict[str, Any]:
    """A candidate drawn in the shares of the kinds, all effects equally likely; the same for the same log.

    Its probabilities are those shares, so they are calibrated; the candidate drawn gets just enough weight to come
    first.
    """
    stamp = b"".join(np.ascontiguousarray(x).tobytes() for x in (log.time, log.accel, log.speed) if x is not None)
    rng = np.random.default_rng(zlib.crc32(stamp))
    effects = sorted(EFFECTS)
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    count = {"single": 1, "pair": 2}.get(kind, 0)
    drawn = "+".join(sorted(rng.choice(effects, count, replace=False).tolist())) or kind
    shares = {name: SHARES["single"] / len(effects) for name in effects}
    shares |= {"none": SHARES["none"], "unknown": SHARES["unknown"]}
    shares[drawn] = max(shares.values()) + 1e-6
    return reply(log, shares, why="drawn at random")
