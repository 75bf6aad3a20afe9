"""Utility of an ambiguity group: what a list of alternative diagnoses is worth to the one who has to repair.

The measure of the synthetic track of the Diagnostic Competition 2026 (benchmark `dxc26synth` of J. de Kleer, option
`--ag`, which takes it from the competitions' paper on metrics). For the diagnosed causes `w`, the true causes `w*` and
`f` components that may be faulty,

    m(w, w*) = 1 - n (N + 1) / (f (n + 1)) - n' (N' + 1) / (f (n' + 1))

with the false positives `n = |w - w*|`, `N = |w|`, the false negatives `n' = |w* - w|` and `N' = f - N`: the first loss
is work on sound parts, the second the search among parts held to be sound. A group of alternatives `D` is worth the
mean of `m` over all pairs of `D` and the true group `T`, divided by that of `T` against itself.

Here a component is an effect of the table, and one more stands for all causes outside it; no cause is the empty set.
The benchmark's true group lists all that its circuits cannot distinguish. A case's true group is its causes alone,
whose utility against itself is 1, so an alias set that lists what no log can tell apart is below 1.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from avtorch.errors import InputError
from benchmarks.blindtest.catalogue import EFFECTS

Causes = frozenset[str]
COMPONENTS = len(EFFECTS) + 1
"""The effects of the table, and one for all causes outside it."""


def utility(diagnosed: Causes, true: Causes, components: int = COMPONENTS) -> float:
    """`m(diagnosed, true)` of the module's docstring, 0 to 1; 1 where both are the same set.

    Raises `InputError` for more causes than `components`.
    """
    if max(len(diagnosed), len(true)) > components:
        raise InputError(f"components: found {components}, needs as many as there are causes or more")
    size, wrong, missed = len(diagnosed), len(diagnosed - true), len(true - diagnosed)
    work = wrong * (size + 1) / (components * (wrong + 1))
    search = missed * (components - size + 1) / (components * (missed + 1))
    return 1 - work - search


def group_utility(
    group: Collection[Causes] | Mapping[Causes, float], true: Collection[Causes], components: int = COMPONENTS
) -> float:
    """Mean utility of the alternatives in `group` against those in `true`, over that of `true` against itself.

    A mapping weighs the alternatives, by probabilities for instance; without any weight above 0 they count alike. It
    can exceed 1 where `true` has several alternatives and `group` is one in their middle. Raises `InputError` for an
    empty group.
    """
    if not group or not true:
        raise InputError("group: found no diagnosis, needs one or more; no cause is the empty set")
    weights = dict(group) if isinstance(group, Mapping) else dict.fromkeys(group, 1.0)
    if sum(weights.values()) <= 0:
        weights = dict.fromkeys(weights, 1.0)
    return _mean(weights, true, components) / _mean(dict.fromkeys(true, 1.0), true, components)


def _mean(weights: Mapping[Causes, float], true: Collection[Causes], components: int) -> float:
    total = sum(weights.values()) * len(true)
    return sum(weight * utility(one, other, components) for one, weight in weights.items() for other in true) / total


def causes(name: str) -> Causes:
    """The causes of a hypothesis by its canonical name: `none` is the empty set, `unknown` one outside the table."""
    return frozenset() if name == "none" else frozenset(name.split("+"))
