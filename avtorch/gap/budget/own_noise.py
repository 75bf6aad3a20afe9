"""The noise of what a selection leaves: under it effects are judged and sized.

A search needs a noise that no missing effect can hide in, so it takes what a flexible regression leaves over. In a
closed loop that is too little: the command follows the measured speed, so a regression on commands predicts some of
the noise itself. A cruising car that has no dead time had one of 0.1 s, by 64 nats. Once the effects are in, what they
leave is noise, of both channels together: a force of chance is in both and counts once.

An acceleration that was computed from the speed is no second channel: the noise of both would be that of the
computation, and a dead band's lag of 0.35 s came out as 0.94. Each channel then has its own noise, and counts as half.

What wanders is noise, too, and hides a force that is slow: of a model car's resistance, 95 nats in the search, it left
none. So the evidence for such an effect is that of the search, where that is stronger.

The noise stays that of all effects found, also once some of them are not likely enough to be named: what a model leaves
that lacks one would hide the others.

Rollouts, and with them shares, keep the fits of the search: that noise makes little of what is slow, and rollouts show
it.
"""

from __future__ import annotations

from dataclasses import replace

from avtorch.gap.budget.held_out_evidence import Evidence
from avtorch.gap.budget.joint_whitening import of_both_channels
from avtorch.gap.budget.noise_whitening import LEVEL_S, NoiseWhitening
from avtorch.gap.budget.redundancy import driven_to_a_limit, without_one
from avtorch.gap.budget.robust_fit import Fit, RobustFit
from avtorch.gap.budget.selection_step import Selection, Step, without_effects
from avtorch.gap.simulator.effect import Effect

_TURNS = 2  # of noise and fit


def own_noise(fit: Fit) -> RobustFit:
    """Fits under the noise of what the model of `fit` leaves."""
    for _ in range(_TURNS):
        judging = _under(fit)
        fit = judging.fit(fit.model, fit.z[None])
    return judging


def judged(fitting: RobustFit, judging: RobustFit, fit: Fit) -> tuple[Step, dict[str, Evidence]]:
    """The model of `fit` without effects that do not hold their place by `judging`, and the evidence for the others.

    The model that stays is fitted under the noise of the search, `fitting`. A slow force has the stronger evidence of
    the two.
    """
    now, step = Step(fit, fitting.hold_out(fit)), _under_its_own(judging, fit)
    while True:
        without, evidence = _each_beside_the_others(fitting, judging, now, step)
        for weakest in sorted((n for n in evidence if evidence[n].of_entry <= 0), key=lambda n: evidence[n].of_entry):
            rest = without_effects(fitting, now.fit, [weakest])
            if not driven_to_a_limit(now.fit, rest):
                break
        else:
            return now, evidence
        step, now = without[weakest], Step(rest, fitting.hold_out(rest))


def evidence_by_own_noise(fitting: RobustFit, judging: RobustFit, fit: Fit) -> dict[str, Evidence]:
    """The evidence for each effect of the model of `fit`, as `judged` takes it; none of them leaves."""
    now, step = Step(fit, fitting.hold_out(fit)), _under_its_own(judging, fit)
    return _each_beside_the_others(fitting, judging, now, step)[1]


def _under_its_own(judging: RobustFit, fit: Fit) -> Step:
    own = judging.fit(fit.model, fit.z[None])
    return Step(own, judging.hold_out(own))


def _each_beside_the_others(
    fitting: RobustFit, judging: RobustFit, now: Step, step: Step
) -> tuple[dict[str, Step], dict[str, Evidence]]:
    """The model without each effect by `judging`, from `step`, and the evidence; `now` is the same by the search."""
    slow = {effect.name for effect in now.fit.model.effects if _is_slow(effect)}
    without = {name: without_one(judging, step, name) for name in step.fit.model.names}
    searched = {name: without_one(fitting, now, name) for name in without if name in slow}
    return without, {name: _stronger(s.evidence, searched.get(name, s).evidence) for name, s in without.items()}


def _is_slow(effect: type[Effect]) -> bool:
    """Whether it is a force by speed, place or nothing, which changes as they do."""
    return effect.slow_force or (effect.place == "body" and not effect.memory)


def _stronger(one: Evidence, other: Evidence) -> Evidence:
    return max(one, other, key=lambda evidence: evidence.of_entry)


def with_sizes(selection: Selection) -> Selection:
    """The selection with the fit that says how large its effects are."""
    judging, fit = selection.judging, selection.last.fit
    if judging is None or not fit.model.names:
        return replace(selection, own=None)
    own = _under_its_own(judging, fit)
    return replace(selection, own=replace(own, held=replace(own.held, z=judging.spread_out(own.fit, own.held))))


def _under(fit: Fit) -> RobustFit:
    """Fits under the noise of `fit`'s residuals."""
    record = fit.model.record
    if len(record.channels) == 1:
        return RobustFit(NoiseWhitening.autoregressive(record, fit.residuals))
    return RobustFit(of_both_channels(record, fit.residuals, level_s=LEVEL_S))
