"""Does a ranking carry over: settings ranked in a simulator, and on the car."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import PermutationMethod, pearsonr, rankdata

from avtorch.errors import InputError

_ORDERS = 40_320  # of eight settings


@dataclass(frozen=True)
class RankAgreement:
    """`srcc`: rank correlation of the simulated and the real scores, from -1 to 1. `p_value`: how often orders by pure
    chance agree as well. `chosen`: the best setting by the simulator, `best`: on the car; `regret`: by how much
    `chosen` scores worse there, in the scores' own unit.
    """

    srcc: float
    p_value: float
    chosen: str
    best: str
    regret: float


def rank_agreement(
    simulated: Mapping[str, float], real: Mapping[str, float], *, higher_is_better: bool = False
) -> RankAgreement:
    """Whether settings have the same order in a simulator as on the car (sim-to-real correlation by ranks).

    `simulated`, `real`: a score of each setting by its name, three settings or more, such as an RMS spacing error [m].
    The correlation is Spearman's (1904), of mean ranks where scores are equal. The p-value is one-sided, exact up to
    eight settings, beyond by as many orders drawn at random.

    Raises `InputError` for other names on either side, fewer settings, scores that are not finite or all equal.

    Example:
        >>> from avtorch.experiment import rank_agreement
        >>> simulated, real = {"soft": 1.2, "firm": 0.8, "hard": 0.9}, {"soft": 1.9, "firm": 1.1, "hard": 1.0}
        >>> rank_agreement(simulated, real).srcc
        0.5
    """
    names = list(simulated)
    if set(names) != set(real) or len(names) < 3:
        raise InputError(
            f"simulated, real: found {len(names)} and {len(real)} settings, needs the same three or more in both"
        )
    a, b = (np.array([float(scores[name]) for name in names]) for scores in (simulated, real))
    for side, x in (("simulated", a), ("real", b)):
        if not np.isfinite(x).all() or np.ptp(x) == 0:
            raise InputError(f"{side}: found scores {x.tolist()}, needs finite ones that are not all equal")
    a, b = (-a, -b) if higher_is_better else (a, b)
    orders = PermutationMethod(n_resamples=_ORDERS, rng=0)
    found: Any = pearsonr(rankdata(a), rankdata(b), alternative="greater", method=orders)
    chosen, best = int(a.argmin()), int(b.argmin())
    return RankAgreement(
        srcc=round(float(found.statistic), 12),
        p_value=float(found.pvalue),
        chosen=names[chosen],
        best=names[best],
        regret=float(b[chosen] - b[best]),
    )
