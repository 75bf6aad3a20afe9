"""Shuffled decks: exact shares in every round, random order, and any card computed from its index alone."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from avtorch.errors import InputError

MIX: dict[str, float] = {"none": 0.25, "single": 0.40, "pair": 0.20, "outside": 0.15}
"""Shares of the kinds of case.

Example:
    >>> from benchmarks.blindtest import MIX
    >>> round(sum(MIX.values()), 6), max(MIX, key=MIX.get)
    (1.0, 'single')
"""
KINDS = (*MIX, "several")
"""All kinds of case; `several` is drawn only where a mix asks for it.

Example:
    >>> from benchmarks.blindtest import KINDS, MIX
    >>> [kind for kind in KINDS if kind not in MIX]
    ['several']
"""
_ROUND = 20


def kind_of(index: int, seed: int, mix: Mapping[str, float] = MIX) -> tuple[str, int]:
    """The kind of case `index`, and the number of earlier cases of that kind in the set `seed`.

    `mix`: shares that sum to 1, kept in every 20 cases (largest remainders). Raises `InputError` for other shares.
    """
    if not mix or set(mix) - set(KINDS) or min(mix.values()) < 0 or abs(sum(mix.values()) - 1) > 1e-9:
        raise InputError(f"mix: found {dict(mix)}, needs shares of {', '.join(KINDS)} that sum to 1")
    counts = {kind: int(_ROUND * share + 1e-9) for kind, share in mix.items()}
    left = sorted(mix, key=lambda kind: counts[kind] - _ROUND * mix[kind])
    for kind in left[: _ROUND - sum(counts.values())]:
        counts[kind] += 1
    deck = [kind for kind, count in counts.items() for _ in range(count)]
    turn, place = divmod(index, _ROUND)
    order = np.random.default_rng([seed, turn, 1]).permutation(_ROUND).tolist()
    kind = deck[order[place]]
    return kind, turn * counts[kind] + sum(deck[card] == kind for card in order[:place])


def card(count: int, seed: int, size: int) -> int:
    """The `count`-th card of a deck of `size` that is reshuffled every round."""
    turn, place = divmod(count, size)
    return int(np.random.default_rng([seed, turn, 2]).permutation(size)[place])
