"""By what one simulator is nearer to a car than another: their differences, each put into the farther one.

Let S be the farther simulator, M its surrogate, and M' the same chain with some parts (lag, gain, effects) as in the
other's surrogate. Then S + M' - M is S with those parts as in the other one, as far as the surrogates are what the
simulators are.

Parts compensate each other (a gain and a drag, a lag and a dead time), so what one is worth depends on which others
have been put in before. Each gets its mean over all orders (Shapley 1953) of what it does to the logarithm of the
error. So the factors of all differences multiply to that of all of them together.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from math import factorial

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.external.scored_blocks import LogRatio, ScoredBlocks
from avtorch.external.simulator_comparison import OTHERS, Difference
from avtorch.gap.rollout_errors import rolled_out
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant

_SAME = 0.01  # relative difference of parameters that is none
_MOST = 6  # differences told one by one; those that do less alone are told together


def differences(
    scored: ScoredBlocks, chains: Sequence[GapPlant], far: int, errors: FloatArray
) -> tuple[Difference, ...]:
    """What the `chains` of two simulators have differently, that which most brings number `far` nearer first.

    `errors` (channel, counted, group): those of the simulator `far`.
    """
    base, donor = chains[far], chains[1 - far]
    own = rolled_out(scored.record, base)
    sides = {name: [_values(chain, name) for chain in chains] for name in _parts(chains)}
    apart = [name for name, (one, two) in sides.items() if not _alike(one, two)]
    known: dict[frozenset[str], LogRatio] = {}
    before = scored.squares(errors, float(base.T_L))

    def with_parts(names: frozenset[str]) -> LogRatio:
        """Of the error with these parts as in the other one to what it is."""
        if names not in known:
            changed = base
            for name in sorted(names):
                changed = _with_part(changed, donor, name)
            moved = errors + own - rolled_out(scored.record, changed) if names else errors
            known[names] = scored.log_ratio(before, scored.squares(moved, float(changed.T_L)))
        return known[names]

    alone = sorted(apart, key=lambda name: -abs(with_parts(frozenset((name,))).mean))
    groups = {name: frozenset((name,)) for name in alone[:_MOST]}
    if alone[_MOST:]:
        groups[OTHERS] = frozenset(alone[_MOST:])
    found = []
    for name, own_parts in groups.items():
        others = [group for other, group in groups.items() if other != name]
        share = LogRatio(0.0, np.zeros(len(scored.blocks)))
        for count in range(len(others) + 1):
            weight = factorial(count) * factorial(len(others) - count) / factorial(len(others) + 1)
            for chosen in combinations(others, count):
                there = frozenset().union(*chosen)
                share += weight * (with_parts(there | own_parts) - with_parts(there))
        one, two = sides.get(name, (None, None))
        found.append(Difference(name, one, two, share.ratio, tuple(sorted(own_parts))))
    return tuple(sorted(found, key=lambda difference: difference.ratio.mean))


def _parts(chains: Sequence[GapPlant]) -> list[str]:
    """`T_L`, `K_L` and the effects of either. An effect that shares the actuator's lag takes `T_L` with it."""
    effects = {e.name: e for chain in chains for e in chain.effects}
    lag = [] if any(_shares_lag(e) for e in effects.values()) else ["T_L"]
    return [*lag, "K_L", *effects]


def _shares_lag(effect: Effect) -> bool:
    return "tau" in effect.actuator_parameters()


def _with_part(base: GapPlant, donor: GapPlant, name: str) -> GapPlant:
    """`base` with one part as in `donor`."""
    if name in ("T_L", "K_L"):
        return base.with_values({name: getattr(donor, name)})
    given = [e for e in donor.effects if e.name == name]
    kept = [e for e in base.effects if e.name != name]
    lag = donor if any(_shares_lag(e) for e in (*donor.effects, *base.effects) if e.name == name) else base
    return GapPlant([*kept, *given], T_L=lag.T_L, K_L=base.K_L, sigma=base.sigma)


def _values(chain: GapPlant, name: str) -> dict[str, float] | None:
    if name in ("T_L", "K_L"):
        return {name: float(getattr(chain, name))}
    report = chain.report()
    return None if name not in report else {k: float(x) for k, x in report[name].items() if x.dim() == 0}


def _alike(one: dict[str, float] | None, two: dict[str, float] | None) -> bool:
    if one is None or two is None or one.keys() != two.keys():
        return False
    return all(np.isclose(one[key], two[key], rtol=_SAME, atol=0.0) for key in one)
