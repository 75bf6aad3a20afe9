"""Models that a selection of effects goes through, and the models between them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from avtorch.gap.budget.held_out_evidence import NOTHING, Evidence
from avtorch.gap.budget.robust_fit import Fit, HeldOut, RobustFit

_REFITTING = 5  # iterations after a model has lost an effect
_ROAD = 16  # parameters that a road counts at most; of 30 to 50 coefficients, data settle some 17 to 28


@dataclass(frozen=True, eq=False)
class Step:
    """A model, the effect that `entered` last, its `evidence` over the model without it, and its `aliases` by name."""

    fit: Fit
    held: HeldOut
    entered: str | None = None
    evidence: Evidence = NOTHING
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Selection:
    """`steps` from the bare baseline on, each with one effect more than the one before; `tried`: of how many.

    `judging`: fits under the noise of what all effects found leave (`own_noise`), `own`: the last model under it, which
    says how large effects are. `sure`: the probability of each effect, once that of others that left is in it.
    """

    fitting: RobustFit
    steps: tuple[Step, ...]
    tried: int = 1
    judging: RobustFit | None = None
    own: Step | None = None
    sure: Mapping[str, float] | None = None

    @property
    def last(self) -> Step:
        return self.steps[-1]

    @property
    def sized(self) -> Step:
        """The model whose parameters are the answer's."""
        return self.last if self.own is None else self.own


def one_by_one(
    fitting: RobustFit, last: Step, evidence: Mapping[str, Evidence], aliases: Mapping[str, tuple[str, ...]]
) -> tuple[Step, ...]:
    """Steps up to `last` whose models grow by one effect each."""
    steps, names = [], last.fit.model.names
    for count, name in enumerate(names, start=1):
        fit = without_effects(fitting, last.fit, names[count:])
        held = last.held if fit is last.fit else fitting.hold_out(fit)
        steps.append(Step(fit, held, name, evidence.get(name, NOTHING), aliases.get(name, (name,))))
    return tuple(steps)


def without_effects(fitting: RobustFit, fit: Fit, names: Collection[str]) -> Fit:
    """The model without some of its effects, fitted anew."""
    if not names:
        return fit
    model = fit.model
    for name in names:
        model = model.without(name)
    return fitting.fit(model, model.coordinates(fit.known)[None], iterations=_REFITTING)


def cost(step: Step) -> float:
    """Nats of the blocks that were held out."""
    return float(step.held.nats.sum())


def complexity(fit: Fit) -> int:
    """Parameters. A long road counts no more than a short one: its coefficients hang together by their prior."""
    model = fit.model
    along = sum(max(at.stop - at.start - _ROAD, 0) for key, at in model.index.items() if key in model.roads)
    return model.size - along + len(model.onsets)
