"""The probability that an effect which held-out blocks select is really there.

What Student's law for the blocks that excite it says of it is too sure where many do, and far too doubtful where two or
three do, as in a drive of a minute. So a logistic regression is fitted to simulated drives behind ideal and ordinary
recorders, on three figures: how much held-out blocks gain by the effect, how well they agree on its size (which has
next to no weight beside the other two on the drives in use), and how much of the response is its own. Where no speed is
recorded the effects that need one are not tried and others stand in for them, so all odds are lower. Wrong effects have
as many chances as are tried, so the odds are in inverse proportion to that. Nothing is surer than Student's law has it
for the best of as many, but where much is gained: each e-fold of nats then counts for one standard error.
``python -m benchmarks.part_odds`` writes its weights, with their provenance, to `part_odds.json` beside this module.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import expit, ndtr

from avtorch.arrays import FloatArray
from avtorch.gap.budget.held_out_evidence import MUCH, Evidence

SCHEMA = "avtorch.part-odds/3"
PATH = Path(__file__).with_name("part_odds.json")
_LEAST_NATS, _LEAST_ERRORS = 0.5, 0.1  # below which there is no evidence
_RESPONSES = (0.01, 0.5)  # beyond which a smaller or larger response says no more
_SUREST = 0.9995  # no frequency on some hundred simulated drives supports more


@dataclass(frozen=True)
class PartOdds:
    """Weights of the log odds where one effect is tried; those of `nats`, `errors` and `response` are of natural
    logarithms, `without_speed` counts where no speed is recorded.

    `none_unnamed`, `unknown_unnamed`: the probabilities that a drive of which no part is likely has no cause, or one
    that no effect describes; else it has an effect too weak to show. `none_wrong`, `unknown_wrong`: the same where a
    part is likely that is not there.
    """

    constant: float
    nats: float
    errors: float
    response: float
    without_speed: float
    none_unnamed: float
    unknown_unnamed: float
    none_wrong: float
    unknown_wrong: float

    @classmethod
    def read(cls) -> PartOdds:
        """The weights in use."""
        return _read()

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> PartOdds:
        """The weights of a file's content."""
        return cls(**{field.name: float(document["constants"][field.name]) for field in fields(cls)})

    @property
    def weights(self) -> FloatArray:
        """In the order of `figures` (5,)."""
        return np.array([self.constant, self.nats, self.errors, self.response, self.without_speed])

    def probability(self, evidence: Evidence, *, response: float, channels: Sequence[str], tried: int) -> float:
        """That the effect is there, the best of as many as were `tried`, on drives with these `channels`.

        `response`: the share of the response that is its own.
        """
        odds = figures(evidence, response, channels) @ self.weights - np.log(max(tried, 1))
        return float(np.clip(min(expit(odds), by_agreement(evidence, tried)), 1 - _SUREST, _SUREST))


def figures(evidence: Evidence, response: float, channels: Sequence[str]) -> FloatArray:
    """What the log odds are linear in (5,), the constant first. Each channel adds to the nats of wrong effects too."""
    nats, own = max(evidence.nats / len(channels), _LEAST_NATS), float(np.clip(response, *_RESPONSES))
    errors = max(evidence.errors, _LEAST_ERRORS)
    return np.array([1.0, np.log(nats), np.log(errors), np.log(own), float("speed" not in channels)])


def by_agreement(evidence: Evidence, tried: int) -> float:
    """As sure as blocks that agree may make of the best of as many as were `tried`."""
    much = np.log(max(evidence.nats, MUCH) / MUCH)
    return float(ndtr(evidence.strength(tried) + much))


@cache
def _read() -> PartOdds:
    return PartOdds.of(json.loads(PATH.read_text(encoding="utf-8")))
