"""A selection under the noise of what it leaves: the evidence for each effect, and its size.

A search needs a noise that no missing effect can hide in, so it takes what a flexible regression leaves over. In a
closed loop that is too little: the command follows the measured speed, so a regression on commands predicts some of
the noise itself. A cruising car that has no dead time had one of 0.1 s, by 64 nats. Once the effects are in, what they
leave is noise, of both channels together: a force of chance is in both and counts once.

What else is missing may hide in that noise, so what is unexplained is asked of the noise of the search.
"""

from __future__ import annotations

from collections.abc import Mapping

from avtorch.gap.budget.joint_whitening import JointWhitening
from avtorch.gap.budget.noise_whitening import LEVEL_S, NoiseWhitening
from avtorch.gap.budget.redundancy import without_the_redundant
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Selection, Step, one_by_one

_TURNS = 2  # of noise and fit


def settled(
    fitting: RobustFit, bare: Fit, fit: Fit, aliases: Mapping[str, tuple[str, ...]], tried: int = 1
) -> Selection:
    """The selection of the effects of `fit` that hold their place under its own noise, with the evidence for each.

    `fitting`: the noise of the search, which an empty selection keeps. `aliases` by name.
    """
    kept: Step | None = None
    if fit.model.names:
        for _ in range(_TURNS):
            judging = _under(fit)
            fit = judging.fit(fit.model, fit.z[None])
        kept, evidence = without_the_redundant(judging, Step(fit, judging.hold_out(fit)))
    if kept is None or not kept.fit.model.names:
        first = fitting.fit(bare.model, bare.z[None])
        return Selection(fitting, (Step(first, fitting.hold_out(first)),), tried)
    first = judging.fit(bare.model, bare.z[None])
    steps = one_by_one(judging, kept, evidence, aliases)
    return Selection(judging, (Step(first, judging.hold_out(first)), *steps), tried, search=fitting)


def _under(fit: Fit) -> RobustFit:
    """Fits under the noise of `fit`'s residuals."""
    record = fit.model.record
    if len(record.channels) == 1:
        return RobustFit(NoiseWhitening.autoregressive(record, fit.residuals))
    return RobustFit(JointWhitening.vector_autoregressive(record, fit.residuals, level_s=LEVEL_S))
