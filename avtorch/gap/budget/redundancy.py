"""Effects that the others of a model do without, by the blocks that were held out."""

from __future__ import annotations

from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Step, without_effects


def without_the_redundant(
    fitting: RobustFit, step: Step, *, spared: str | None = None
) -> tuple[Step, dict[str, Evidence]]:
    """The model without effects that do not hold their place, weakest first, and the evidence for each that does.

    One stays whose going drives another to a limit of what a fit may take: that would stand in for it.
    """
    while True:
        without = {name: without_one(fitting, step, name) for name in step.fit.model.names if name != spared}
        leaving = [s for s in without.values() if s.evidence.of_entry <= 0 and not driven_to_a_limit(step.fit, s.fit)]
        if not leaving:
            return step, {name: s.evidence for name, s in without.items()}
        step = min(leaving, key=lambda s: s.evidence.of_entry)


def at_limits(fit: Fit) -> list[str]:
    """The effects of a model that rest at a limit."""
    return [name for name in fit.model.names if fit.model.at_limit(fit.z, name)]


def driven_to_a_limit(before: Fit, after: Fit) -> bool:
    """Whether an effect rests at a limit `after` that did not `before`: it stands in for what is missing there."""
    return not set(at_limits(after)) <= set(at_limits(before))


def without_one(fitting: RobustFit, step: Step, name: str) -> Step:
    """`step` without an effect, with the evidence for that one."""
    fit = without_effects(fitting, step.fit, [name])
    held = fitting.hold_out(fit)
    return Step(fit, held, evidence=fitting.evidence(held, step.held))
