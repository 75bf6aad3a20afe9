"""The evidence for each effect of a selection, under the noise of what the selection leaves.

A search needs a noise that no missing effect can hide in, so it takes what a flexible regression leaves over. In a
closed loop that is too little: the command follows the measured speed, so a regression on commands predicts some of
the noise itself. A cruising car that has no dead time had one of 0.1 s, by 64 nats. Once the effects are in, what they
leave is noise, of both channels together: a force of chance is in both and counts once.
"""

from __future__ import annotations

from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.joint_whitening import JointWhitening
from avtorch.gap.budget.noise_whitening import LEVEL_S, NoiseWhitening
from avtorch.gap.budget.redundancy import without_the_redundant
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Step, without_effects

_TURNS = 2  # of noise and fit


def judged(fitting: RobustFit, now: Step) -> tuple[Step, dict[str, Evidence]]:
    """`now` without effects that do not hold their place under its own noise, and the evidence for the others there.

    The model that stays is fitted as it was: which effects there are is asked, not how large they are.
    """
    if not now.fit.model.names:
        return now, {}
    fit = now.fit
    for _ in range(_TURNS):
        judging = _under(fit)
        fit = judging.fit(fit.model, fit.z[None])
    kept, evidence = without_the_redundant(judging, Step(fit, judging.hold_out(fit)))
    gone = [name for name in now.fit.model.names if name not in kept.fit.model.names]
    if not gone:
        return now, evidence
    rest = without_effects(fitting, now.fit, gone)
    return Step(rest, fitting.hold_out(rest)), evidence


def _under(fit: Fit) -> RobustFit:
    """Fits under the noise of `fit`'s residuals."""
    record = fit.model.record
    if len(record.channels) == 1:
        return RobustFit(NoiseWhitening.autoregressive(record, fit.residuals))
    return RobustFit(JointWhitening.vector_autoregressive(record, fit.residuals, level_s=LEVEL_S))
