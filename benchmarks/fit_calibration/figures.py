"""Quality of the constants: a quarter of the cases is held out and answered with the constants fitted to the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avtorch.blindtest.answers import Answered
from avtorch.blindtest.score import auroc, ece
from avtorch.gap.selection import model_probabilities as odds
from avtorch.gap.selection.calibration import CALIBRATION
from benchmarks.fit_calibration.cases import KeptCase, weights
from benchmarks.fit_calibration.fit import Fitted, fit

SHARE = 0.25


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


def answered(case: KeptCase, found: Fitted) -> Answered:
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
