"""The noise of what a selection leaves: under it effects are judged and sized.

A search needs a noise that no missing effect can hide in, so it takes what a flexible regression leaves over. In a
closed loop that is too little: the command follows the measured speed, so a regression on commands predicts some of
the noise itself. A cruising car that has no dead time had one of 0.1 s, by 64 nats. Once the effects are in, what they
leave is noise, of both channels together: a force of chance is in both and counts once.

Rollouts, and with them shares, keep the fits of the search: that noise makes little of what is slow, and rollouts show
it.
"""

from __future__ import annotations

from dataclasses import replace

from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.joint_whitening import JointWhitening
from avtorch.gap.budget.noise_whitening import LEVEL_S, NoiseWhitening
from avtorch.gap.budget.redundancy import without_the_redundant
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Selection, Step, without_effects

_TURNS = 2  # of noise and fit


def judged(fitting: RobustFit, now: Step) -> tuple[Step, dict[str, Evidence]]:
    """`now` without effects that do not hold their place under its own noise, and the evidence for the others there.

    The model that stays is fitted under the noise of the search, `fitting`.
    """
    if not now.fit.model.names:
        return now, {}
    judging, own = _own(now.fit)
    kept, evidence = without_the_redundant(judging, own)
    gone = [name for name in now.fit.model.names if name not in kept.fit.model.names]
    if not gone:
        return now, evidence
    rest = without_effects(fitting, now.fit, gone)
    return Step(rest, fitting.hold_out(rest)), evidence


def with_own_noise(selection: Selection) -> Selection:
    """The selection with the fit that says how large its effects are."""
    if not selection.last.fit.model.names:
        return replace(selection, own=None)
    return replace(selection, own=_own(selection.last.fit)[1])


def _own(fit: Fit) -> tuple[RobustFit, Step]:
    """Fits under the noise of what the model of `fit` leaves, and that model under it."""
    for _ in range(_TURNS):
        judging = _under(fit)
        fit = judging.fit(fit.model, fit.z[None])
    return judging, Step(fit, judging.hold_out(fit))


def _under(fit: Fit) -> RobustFit:
    """Fits under the noise of `fit`'s residuals."""
    record = fit.model.record
    if len(record.channels) == 1:
        return RobustFit(NoiseWhitening.autoregressive(record, fit.residuals))
    return RobustFit(JointWhitening.vector_autoregressive(record, fit.residuals, level_s=LEVEL_S))
