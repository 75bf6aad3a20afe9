"""The effects of a selection that are parts of the gap, and likely enough to be named."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from avtorch.gap.answer.budget import LIKELY, MATERIAL
from avtorch.gap.budget.own_noise import evidence_by_own_noise, judged, with_sizes
from avtorch.gap.budget.part_odds import PartOdds
from avtorch.gap.budget.redundancy import at_limits
from avtorch.gap.budget.selection_step import Selection, one_by_one, without_effects
from avtorch.gap.budget.share_order import largest_first, own_response


def likely_parts(selection: Selection, material: float = MATERIAL, *, seed: int = 0) -> Selection:
    """The selection's parts in the order of what they take off the gap, without those less likely there than not, or
    at the limit of what a fit may take.

    The least likely goes first, unless that drives another to a limit. The others are then as likely as they are
    beside it and without it, each as far as it is likely itself.
    """
    selection = _parts(selection, material, seed)
    each = probabilities(selection)
    while each:
        # where a fit ends, far beyond what is possible, an effect stands in for something else
        each |= dict.fromkeys(at_limits(selection.last.fit), 0.0)
        unlikely = sorted((name for name in each if each[name] < LIKELY), key=each.__getitem__)
        if not unlikely:
            break
        selection = _parts(_without_one_of(selection, unlikely), material, seed)
        without = probabilities(selection)
        there = min(each[name] for name in each if name not in without)
        if there >= LIKELY:  # it left as it stood in for another, which is likely by what it is without it
            there = 0.0
        each = {name: there * each[name] + (1 - there) * p for name, p in without.items()}
    return replace(with_sizes(selection), sure=each)


def _parts(selection: Selection, material: float, seed: int) -> Selection:
    """The selection's parts in order; where an effect is none, the evidence for the others is asked anew.

    None of them leaves by that: which of several unlikely ones does is decided with limits in view.
    """
    parts = largest_first(selection, material, seed=seed)
    if len(parts.steps) in (1, len(selection.steps)):
        return parts
    fitting, judging = parts.fitting, parts.judging
    evidence = evidence_by_own_noise(fitting, fitting if judging is None else judging, parts.last.fit)
    bare, *steps = parts.steps
    return replace(parts, steps=(bare, *(replace(step, evidence=evidence[str(step.entered)]) for step in steps)))


def probabilities(selection: Selection) -> dict[str, float]:
    """That each effect is there, by name."""
    if selection.sure is not None:
        return dict(selection.sure)
    odds, channels, last = PartOdds.read(), selection.fitting.whitening.record.channels, selection.last
    return {
        name: odds.probability(
            step.evidence, response=own_response(last, name), channels=channels, tried=selection.tried
        )
        for name, step in ((str(step.entered), step) for step in selection.steps[1:])
    }


def _without_one_of(selection: Selection, names: Sequence[str]) -> Selection:
    """Without the first of `names` that drives no other effect to a limit, or without the very first.

    Two forces that explain the same may each be unlikely beside the other. On the AV-21's lap the resistance went,
    its drag then had to stand in for it, rested at a limit and went too, and nothing was left of a force of 600 nats.
    So what would rest at a limit is tried as well: it stands in for the one that would leave.
    """
    order, without = list(names), list[Selection]()
    while len(without) < len(order):
        without.append(_without(selection, order[len(without)]))
        resting = at_limits(without[-1].last.fit)
        if not resting:
            return without[-1]
        order += [name for name in resting if name not in order]
    return without[0]


def _without(selection: Selection, name: str) -> Selection:
    fitting, judging = selection.fitting, selection.judging
    fit = without_effects(fitting, selection.last.fit, [name])
    last, evidence = judged(fitting, fitting if judging is None else judging, fit)
    aliases = {str(s.entered): s.aliases for s in selection.steps[1:]}
    return replace(selection, steps=(selection.steps[0], *one_by_one(fitting, last, evidence, aliases)))
