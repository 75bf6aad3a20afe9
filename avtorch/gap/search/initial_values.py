"""Starting values of a search: a few values of each effect's parameters, for likelihoods with several modes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from math import prod

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.likelihood.hypothesis import Hypothesis
from avtorch.gap.simulator.integrated import Integrated

_TRADES = tuple(s * k for k in (0.012, 0.025, 0.04, 0.06, 0.085, 0.12) for s in (-1, 1))
"""Trades of a delay for lag [s]."""
_LEAST_S = 0.01
_MANY = 100


def effect_starts(hypothesis: Hypothesis, name: str) -> list[dict[str, float]]:
    """Starting values of one effect, by key in the plant."""
    kind = next(e for e in hypothesis.effects if e.name == name)
    grid = kind.starts_in(*_span(hypothesis))
    if not grid:  # a user's effect: typical, and weaker
        sized = [c for c in hypothesis.coordinates if c.key.startswith(f"{name}.")]
        return [
            {c.key: float(c.value(np.array(at))) for c in sized if c.parameter.neutral is not None}
            for at in (-1.0, 0.0)
        ]
    keys = [f"{name}.{key}" for key in grid]
    return [dict(zip(keys, values, strict=True)) for values in product(*grid.values())]


def _span(hypothesis: Hypothesis) -> tuple[float, float]:
    """Start and end of the first drive [s]."""
    time = hypothesis.record.drives[0].time
    return float(time[0]), float(time[-1])


def one_at_a_time(hypothesis: Hypothesis, z: FloatArray) -> FloatArray:
    """Starts (start, coordinate) that differ from `z` in one parameter of an effect, set to one of its initial values.

    A limit that is never reached has zero derivative, and the nearest mode need not be the best.
    """
    places = []
    kinds, span = {e.name: e for e in hypothesis.effects}, _span(hypothesis)
    for i, c in enumerate(hypothesis.coordinates):
        effect, _, key = c.key.partition(".")
        if effect not in kinds or prod(map(len, kinds[effect].starts_in(*span).values())) > _MANY:
            continue  # the latter is already searched closely
        for value in kinds[effect].retried_in(*span).get(key, ()):
            place = z.copy()
            place[i] = c.z_of(value)
            places.append(place)
    return np.array(places).reshape(-1, len(z))


def lag_delay_starts(hypothesis: Hypothesis, z: FloatArray) -> FloatArray:
    """Starts (start, coordinate) with a longer delay and a shorter lag than `z`, or the reverse.

    Along this valley the likelihood is rough: a held command that arrives between two rows causes a kink at every row.
    """
    own = {key: float(x[0]) for key, x in hypothesis.values(z[None]).items()}
    places = []
    for key in (f"{e.name}.{e.shift}" for e in hypothesis.effects if e.shift is not None):
        lag, delay = own["T_L"], own[key]
        shifts = [s for s in _TRADES if min(lag - s, delay + s) > _LEAST_S]
        places += [hypothesis.z_of({**own, "T_L": lag - s, key: delay + s}) for s in shifts]
    return np.array(places).reshape(-1, len(z))


def start_points(hypothesis: Hypothesis, base: Mapping[str, float]) -> FloatArray:
    """(start, coordinate): `base` (T_L, K_L, known effect parameters) combined with each effect's initial values."""
    sets: list[dict[str, float]] = [dict(base)]
    for effect in hypothesis.effects:
        known = any(key.startswith(f"{effect.name}.") for key in base)
        if known or effect.random or issubclass(effect, Integrated):
            continue
        sets = [{**a, **b} for a in sets for b in effect_starts(hypothesis, effect.name)]
    return np.stack([hypothesis.z_of(s) for s in _unique(sets)])


def _unique(sets: list[dict[str, float]]) -> Iterator[dict[str, float]]:
    seen = set()
    for s in sets:
        mark = tuple(sorted(s.items()))
        if mark not in seen:
            seen.add(mark)
            yield s
