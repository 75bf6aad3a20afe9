"""Does a ranking carry over: settings ranked in a simulator, and on the car."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy.stats import rankdata

from avtorch.errors import InputError

_EXACT = 8  # settings whose orders are all counted
_DRAWS = 20_000


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
    eight settings, beyond by 20,000 orders drawn at random.

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
    ranks = [(r - r.mean()) / np.linalg.norm(r - r.mean()) for r in (rankdata(a), rankdata(b))]
    srcc = float(ranks[0] @ ranks[1])
    if len(names) <= _EXACT:
        orders = np.array(list(permutations(range(len(names)))))
    else:
        rng = np.random.default_rng(0)
        orders = np.stack([np.arange(len(names)), *(rng.permutation(len(names)) for _ in range(_DRAWS))])
    by_chance = ranks[1][orders] @ ranks[0]
    chosen = int(a.argmin())
    return RankAgreement(
        round(srcc, 12),
        float((by_chance >= srcc - 1e-9).mean()),
        names[chosen],
        names[int(b.argmin())],
        float(b[chosen] - b.min()),
    )
