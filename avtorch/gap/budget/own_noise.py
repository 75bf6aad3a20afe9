"""The noise of what a selection leaves: under it effects are judged and sized.

A search needs a noise that no missing effect can hide in, so it takes what a flexible regression leaves over. In a
closed loop that is too little: the command follows the measured speed, so a regression on commands predicts some of
the noise itself. A cruising car that has no dead time had one of 0.1 s, by 64 nats. Once the effects are in, what they
leave is noise, of both channels together: a force of chance is in both and counts once.

It stays that of all effects found, also once some of them are not likely enough to be named: what a model leaves that
lacks one would hide the others.

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


def own_noise(fit: Fit) -> RobustFit:
    """Fits under the noise of what the model of `fit` leaves."""
    for _ in range(_TURNS):
        judging = _under(fit)
        fit = judging.fit(fit.model, fit.z[None])
    return judging


def judged(fitting: RobustFit, judging: RobustFit, fit: Fit) -> tuple[Step, dict[str, Evidence]]:
    """The model of `fit` without effects that do not hold their place by `judging`, and the evidence for the others.

    The model that stays is fitted under the noise of the search, `fitting`.
    """
    own = judging.fit(fit.model, fit.z[None])
    kept, evidence = without_the_redundant(judging, Step(own, judging.hold_out(own)))
    gone = [name for name in fit.model.names if name not in kept.fit.model.names]
    rest = without_effects(fitting, fit, gone)
    return Step(rest, fitting.hold_out(rest)), evidence


def with_sizes(selection: Selection) -> Selection:
    """The selection with the fit that says how large its effects are."""
    judging, fit = selection.judging, selection.last.fit
    if judging is None or not fit.model.names:
        return replace(selection, own=None)
    own = judging.fit(fit.model, fit.z[None])
    return replace(selection, own=Step(own, judging.hold_out(own)))


def _under(fit: Fit) -> RobustFit:
    """Fits under the noise of `fit`'s residuals."""
    record = fit.model.record
    if len(record.channels) == 1:
        return RobustFit(NoiseWhitening.autoregressive(record, fit.residuals))
    return RobustFit(JointWhitening.vector_autoregressive(record, fit.residuals, level_s=LEVEL_S))
