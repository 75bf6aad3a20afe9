"""From stored answers to `blindtest.json`: the scores of the method under test and of its rivals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avtorch.blindtest import score
from avtorch.trial.folder import TrialFolder


def tally(folder: TrialFolder, n: int, names: Sequence[str], settings: Mapping[str, Any]) -> dict[str, Any]:
    """`avtorch.blindtest/1` of cases 0 to `n - 1`, all of them answered; the first of `names` is the method under
    test."""
    truths = [folder.truth(i) for i in range(n)]
    measures = {name: _measures(folder, name, truths) for name in names}
    tested = measures.pop(names[0])
    return {
        "schema": "avtorch.blindtest/1",
        "cases": n,
        "seed": settings["seed"],
        "answerer": names[0],
        "signals": list(settings["signals"]),
        "outside": settings["outside"],
        "mix": settings["mix"],
        "draw": settings["draw"],
        **tested,
        "baselines": measures,
    }


def _measures(folder: TrialFolder, name: str, truths: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    kept = [folder.answer(name, i) for i in range(len(truths))]
    found = score(truths, [one["answer"] for one in kept], seconds=[one["seconds"] for one in kept])
    failures = [one["error"] for one in kept if one["error"]]
    return {
        **found,
        "cpu_seconds_per_case": float(np.mean([one["cpu_seconds"] for one in kept])) if kept else None,
        "failed": len(failures),
        "failures": sorted(set(failures))[:5],
    }
