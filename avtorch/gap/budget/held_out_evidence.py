"""Whether blocks that were held out agree that a model predicts them better than another.

A model's gain differs from block to block for two reasons: blocks that excite an effect can show more of it, and the
noise is what it is. So each block is asked for the size of the change that it sees, in proportion to what the model
predicts. The standard error is that of a jackknife over blocks, which holds whatever the noise within a block is
(Liang and Zeger's sandwich); Student's law has as many degrees of freedom as blocks that excite the change. An effect
that shows in a single block is one event, however large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from avtorch.arrays import FloatArray

FALSE_ALARMS = 0.02
"""Share of models without anything left to find in which a wrong effect may enter, whatever the number tried."""
_LEAST_FREEDOM = 1.0
_LEEWAY = 0.6  # standard errors, by which an effect that gains much may fall short and enter
MUCH = 25.0
"""Nats from which an effect gains much."""


@dataclass(frozen=True)
class Evidence:
    """Held-out blocks on a second model against a first: `nats` in sum, `errors` standard errors, `freedom` degrees."""

    nats: float
    errors: float
    freedom: float

    def strength(self, tried: int = 1) -> float:
        """Standard normal errors above what the best of `tried` wrong models reaches with `FALSE_ALARMS`.

        By the law of the blocks' agreement, and by Markov's bound on a likelihood ratio; the weaker of the two.
        """
        level = FALSE_ALARMS / max(tried, 1)
        # log of the tail, as it is below any double for strong effects
        beyond = float(special.stdtr(self.freedom, -self.errors))
        reached = -float(special.ndtri(max(beyond, 1e-300)))
        by_ratio = (self.nats + np.log(level)) / np.sqrt(2 * max(abs(self.nats), 1.0))
        return min(reached + float(special.ndtri(level)), float(by_ratio))

    @property
    def of_entry(self) -> float:
        """`strength` of one model, with some leeway where much is gained.

        With a dozen blocks, two or three of which excite an effect, Student's law rejects nearly all. What enters is
        judged at the end by all its figures (`part_odds`).
        """
        return self.strength() + (_LEEWAY if self.nats > MUCH else 0.0)


NOTHING = Evidence(0.0, 0.0, _LEAST_FREEDOM)
"""No evidence either way."""


def agreement(score: FloatArray, size: FloatArray) -> tuple[float, float]:
    """Standard errors by which the sum of `score` (block,) exceeds zero, and degrees of freedom.

    `size` (block,) is what `score` is in proportion to where all blocks agree.
    """
    total, whole = float(score.sum()), float(size.sum())
    if whole <= 0:
        return 0.0, _LEAST_FREEDOM
    # by the other blocks
    slope = (total - score) / np.maximum(whole - size, 1e-9 * whole)
    error = float(np.sqrt(((score - slope * size) ** 2).sum()))
    freedom = whole**2 / float((size**2).sum()) - 1.0
    return total / max(error, 1e-12), max(freedom, _LEAST_FREEDOM)
