"""Quality of the constants: a quarter of the cases is held out and answered with the constants fitted to the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from avtorch.blindtest.answers import Answered
from avtorch.blindtest.score import auroc, ece
from avtorch.gap.selection import model_probabilities as odds
from avtorch.gap.selection.calibration import CALIBRATION, Odds, UnknownWeights
from benchmarks.fit_calibration.cases import KeptCase, weights
from benchmarks.fit_calibration.fit import MISSED, fit

SHARE = 0.25
_FOLDS = 7  # as many as there are decks of 20 in 140 cases


class Constants(Protocol):
    """Fitted ones, or those of `calibration.json`."""

    @property
    def odds(self) -> Odds: ...
    @property
    def unknown(self) -> UnknownWeights: ...


def held_out(cases: Sequence[KeptCase], seed: int) -> dict[str, float]:
    """Calibration error and area under the ROC curve of `unknown` on a quarter of every kind, drawn by `seed`."""
    rng = np.random.default_rng(seed)
    out: set[int] = set()
    for kind in sorted({case.kind for case in cases}):
        own = [case.index for case in cases if case.kind == kind]
        out |= set(rng.permutation(own)[: max(1, round(SHARE * len(own)))].tolist())
    kept = [case for case in cases if case.index not in out]
    found = fit(kept, weights(kept))
    rows = [answered(case, found) for case in cases if case.index in out]
    error, area = ece(rows), auroc(rows)
    assert error is not None
    assert area is not None  # every kind is among them
    return {"share": SHARE, "calibration_error": round(error, 3), "unknown_auroc": round(area, 3)}


def compared(cases: Sequence[KeptCase], seed: int) -> dict[str, float]:
    """The constants in use against those that a fit to other cases gives, on cases that neither has seen.

    `nats`: what a case's right answer gains in log probability by the new fit (each case by a fit to six sevenths of
    the others), with its standard `error`; calibration error and area under the ROC curve of `unknown` for both.
    """
    fold = np.random.default_rng(seed).permutation(np.arange(len(cases)) % _FOLDS)
    new: dict[int, Answered] = {}
    for k in range(_FOLDS):
        kept = [case for case, own in zip(cases, fold, strict=True) if own != k]
        found = fit(kept, weights(kept))
        new |= {i: answered(case, found) for i, case in enumerate(cases) if fold[i] == k}
    rows = {"used": [answered(case, CALIBRATION) for case in cases], "new": [new[i] for i in range(len(cases))]}
    nats = {name: np.log([max(r.probabilities.get(r.truth, 0.0), MISSED) for r in rows[name]]) for name in rows}
    gain = nats["new"] - nats["used"]
    out = {"nats": float(gain.mean()), "error": float(gain.std(ddof=1) / np.sqrt(len(gain)))}
    for name, answers in rows.items():
        error, area = ece(answers), auroc(answers)
        assert error is not None
        assert area is not None
        out |= {f"calibration_error_{name}": error, f"unknown_auroc_{name}": area}
    return {key: round(value, 3) for key, value in out.items()}


def answered(case: KeptCase, found: Constants) -> Answered:
    """The probabilities of a case; the figures do not use the other parts of a verdict."""
    calibration = replace(CALIBRATION, odds=found.odds, unknown=found.unknown)
    left = case.left[odds.favourite(case.found, found.odds).name]
    chances = odds.model_probabilities(case.found, left, calibration=calibration)
    first = max(chances, key=lambda name: chances[name])
    return Answered(
        truth=case.truth,
        kind=case.kind,
        tier=None,
        verdict=first,
        probabilities=chances,
        alias_set=frozenset({first}),
        closed_error=None,
        closed_covered=None,
        placebo=None,
        onset_error=None,
        overlaps=(),
        parts_named=0,
    )
