"""The probability that an effect which held-out blocks select is really there.

What the blocks' agreement alone says of it is too sure: a recorder's delay of 50 ms is certain on a long drive, and no
cause. A logistic regression on four figures is fitted to simulated drives behind ideal and ordinary recorders: what the
effect gains on held-out blocks, how few of them show it, how many there are, and how large the gap is. Wrong effects
have as many chances as are tried, so the odds are in inverse proportion to that.
``python -m benchmarks.part_odds`` writes its weights, with their provenance, to `part_odds.json` beside this module.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit

from avtorch.arrays import FloatArray
from avtorch.gap.budget.held_out_evidence import Evidence

SCHEMA = "avtorch.part-odds/1"
PATH = Path(__file__).with_name("part_odds.json")
_LEAST_GAP = 0.1  # of the floor's energy, below which rollouts show none
_SUREST = 0.9995  # no frequency on some hundred simulated drives supports more


@dataclass(frozen=True)
class PartOdds:
    """Weights of the log odds where one effect is tried; those but `constant` are of natural logarithms."""

    constant: float
    nats: float
    freedom: float
    blocks: float
    gap: float

    @classmethod
    def read(cls) -> PartOdds:
        """The weights in use."""
        return _read()

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> PartOdds:
        """The weights of a file's content."""
        return cls(**{field.name: float(document["weights"][field.name]) for field in fields(cls)})

    @property
    def weights(self) -> FloatArray:
        """In the order of `figures` (5,)."""
        return np.array([self.constant, self.nats, self.freedom, self.blocks, self.gap])

    def probability(self, evidence: Evidence, *, blocks: int, gap: float, tried: int) -> float:
        """That the effect is there, the best of as many as were `tried`.

        `gap` is the energy of the baseline's error above its floor, in units of that.
        """
        odds = figures(evidence, blocks, gap) @ self.weights - np.log(max(tried, 1))
        return float(np.clip(expit(odds), 1 - _SUREST, _SUREST))


def figures(evidence: Evidence, blocks: int, gap: float) -> FloatArray:
    """What the log odds are linear in (5,), the constant first."""
    nats = np.log(max(evidence.nats, 1.0))
    return np.array([1.0, nats, np.log(evidence.freedom), np.log(blocks), np.log(max(gap, _LEAST_GAP))])


@cache
def _read() -> PartOdds:
    return PartOdds.of(json.loads(PATH.read_text(encoding="utf-8")))
