"""Effects of a model that others replace, where the blocks that were held out prefer these.

What entered first had to explain what all the missing effects do together. Once the others are in, another effect may
explain its part better: each is taken out in turn, and what would enter in its place is compared with it. A score test
cannot say beforehand where that pays: of two exchanges that were right, neither was promised half of what it gained.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from avtorch.gap.budget.entry import LEAST_NATS
from avtorch.gap.budget.next_step import next_step
from avtorch.gap.budget.redundancy import driven_to_a_limit
from avtorch.gap.budget.robust_fit import RobustFit
from avtorch.gap.budget.selection_step import Step, without_effects
from avtorch.gap.search.checkpoint import Checkpoint
from avtorch.gap.simulator.effect import Effect

_OF_ITS_GAIN = 0.3  # what takes a place promises that much of what the effect there gains, and reaches all of it


def exchanged(
    fitting: RobustFit,
    now: Step,
    kinds: Sequence[type[Effect]],
    progress: Callable[[str, int, int], None] | None = None,
    checkpoint: Checkpoint | None = None,
    *,
    settled: str | None = None,
) -> tuple[Step, dict[str, Step]]:
    """`now` after all exchanges, and the steps by which new effects entered, by their names.

    `kinds`: effects that may take another's place. Those of `now` are tried from the weakest on, each once. `settled`:
    one that was chosen of all `kinds` for its place in this very model, which is not tried while nothing has changed.
    """
    entered: dict[str, Step] = {}
    without = {name: _without(fitting, now, name) for name in now.fit.model.names}
    strengths = {name: fitting.evidence(step.held, now.held).strength() for name, step in without.items()}
    for name in sorted(strengths, key=strengths.__getitem__):
        if name == settled and not entered:
            continue
        # those made of a model in which nothing has been exchanged yet still hold
        before = _without(fitting, now, name) if entered else without[name]
        others = [kind for kind in kinds if kind.name != name]
        least = max(LEAST_NATS, _OF_ITS_GAIN * (before.fit.nats - now.fit.nats))
        step = next_step(fitting, before, others, progress, f"in place of {name}", checkpoint, least=least)
        if step is None or fitting.preference(now.held, step.held).strength() <= 0:
            continue
        if driven_to_a_limit(now.fit, step.fit):
            continue
        now, entered[step.fit.model.names[-1]] = step, step
    return now, entered


def _without(fitting: RobustFit, now: Step, name: str) -> Step:
    rest = without_effects(fitting, now.fit, [name])
    return Step(rest, fitting.hold_out(rest))


def taken_over(
    fitting: RobustFit,
    now: Step,
    entered: Mapping[str, Step],
    kinds: Sequence[type[Effect]],
    checkpoint: Checkpoint | None = None,
) -> Step:
    """`now` without an effect that the last one does for, fitted as if it had come in its place.

    What explains the same as an effect before it may enter beside that, with the size and the onset of what that
    leaves. Neither of them is then redundant, where the last one alone would be enough.
    """
    last = now.fit.model.names[-1]
    for name in now.fit.model.names[:-1]:
        if last not in entered[name].aliases:
            continue
        rest = without_effects(fitting, now.fit, [name, last])
        before = Step(rest, fitting.hold_out(rest))
        own = [kind for kind in kinds if kind.name == last]
        alone = next_step(fitting, before, own, None, f"in place of {name}", checkpoint)
        if alone is None or driven_to_a_limit(now.fit, alone.fit):
            continue
        if fitting.evidence(alone.held, now.held).of_entry <= 0:
            return replace(alone, aliases=entered[name].aliases)
    return now
