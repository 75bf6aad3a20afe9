"""An answer of `avtorch.diagnosis/1` from the few numbers that a rival computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io import Log


def reply(
    log: Log,
    probabilities: Mapping[str, float],
    *,
    why: str,
    baseline: Mapping[str, tuple[float, float]] | None = None,
    log_evidence: Mapping[str, float] | None = None,
    parameters: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    onset_s: float | None = None,
    p_value: float | None = None,
) -> dict[str, Any]:
    """The most probable candidate is the verdict; the fewest that reach 95 % together with it are the alias set.

    Args: `probabilities` of candidates, at any scale; `none` and `unknown` are added with 0. `baseline`, `parameters`:
    (mean, sd) of normal laws. `log_evidence` relative to `none`. Candidates below 1e-4 are left out.

    Example:
        >>> from avtorch.io import Log
        >>> from benchmarks.blindtest.reply import reply
        >>> log = Log.from_arrays(time=[0.0, 0.1, 0.2], accel_cmd=[0.0, 0.5, 1.0], accel=[0.0, 0.1, 0.4])
        >>> answer = reply(log, {"dead_time": 6.0, "rate_limit": 3.0, "none": 1.0}, why="the response comes late")
        >>> answer["verdict"]["alias_set"]
        ['dead_time', 'rate_limit', 'none']
    """
    weights = {"none": 0.0, "unknown": 0.0} | {name: float(p) for name, p in probabilities.items()}
    total = sum(weights.values())
    kept = {
        name: p / total
        for name, p in weights.items()
        if p / total >= 1e-4 or name in ("none", "unknown")
    }  # fmt: skip
    left = sum(kept.values())
    ranked = sorted(((name, p / left) for name, p in kept.items()), key=lambda one: -one[1])
    top, _ = ranked[0]
    alias, reached = [], 0.0
    for name, p in ranked:
        alias.append(name)
        reached += p
        if reached >= 0.95:
            break
    return {
        "schema": "avtorch.diagnosis/1",
        "log": {
            "rows": log.rows,
            "segments": len(log.segments()),
            "seconds": log.seconds,
            "rate_hz": log.rate_hz,
        },
        "baseline": {k: normal(*(baseline or {}).get(k, (1.0, 0.0))) for k in ("T_L", "K_L")},
        "gap": {"one_step": None, "rollout": None, "detected": top != "none", "p_value": p_value},
        "where": [],
        "onset_s": onset_s,
        "effects": [
            {
                "name": name,
                "probability": p,
                "log_evidence": (log_evidence or {}).get(name),
                "parameters": {k: normal(*x) for k, x in (parameters or {}).get(name, {}).items()},
            }
            for name, p in ranked
        ],
        "verdict": {"names": top.split("+"), "alias_set": alias, "abstained": top == "unknown", "why": why},
        "shrinkage": None,
        "next_experiment": None,
    }


def normal(mean: float, sd: float) -> dict[str, float]:
    """Mean, standard deviation and 5 and 95 % quantiles of a normal law."""
    return {"mean": mean, "sd": sd, "q05": mean - 1.6448536269514722 * sd, "q95": mean + 1.6448536269514722 * sd}


def softmax(scores: Sequence[float]) -> FloatArray:
    """Weights that sum to 1, in proportion to the exponentials."""
    x = np.asarray(scores, float)
    grown = np.exp(x - x.max())
    return grown / grown.sum()
