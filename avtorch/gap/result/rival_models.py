"""Models of a verdict that held-out blocks selected, and of the sets of effects that could take its place.

The first is the repaired simulator. The others are fitted as it was: with an alias in place of the effect that these
drives cannot distinguish from it, and without the least certain part where that is no surer than an alias set is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from avtorch.arrays import FloatArray
from avtorch.gap.answer.budget import LIKELY, Budget
from avtorch.gap.answer.verdict import ALIAS_RATIO, ALWAYS, Verdict, candidate_name
from avtorch.gap.budget.entry import candidates_for, fitted, observable
from avtorch.gap.budget.repaired_model import draws_of, places, plant_of
from avtorch.gap.budget.robust_fit import Fit
from avtorch.gap.budget.selection_step import Selection, Step, without_effects
from avtorch.gap.drive_record import Record
from avtorch.gap.likelihood.noise_fit import GUST, PRIORS, fit_noise
from avtorch.gap.likelihood.noise_model import NoiseModel
from avtorch.gap.result.predictive_model import MOST_MODELS, PredictiveModel
from avtorch.gap.simulator.effect import EFFECTS, Effect
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant, plant


@dataclass(frozen=True)
class RivalSets:
    """The named effects `names`, and how probable each other set is beside them, by its name: `beside`, relative."""

    names: frozenset[str]
    beside: Mapping[str, float]

    @classmethod
    def of(cls, budget: Budget, verdict: Verdict) -> RivalSets:
        """Blocks cannot tell an alias from what it replaces, so both are as probable; what a part is not, the rest is.

        A part is left out where the set without it is as probable, relative to the set with it, as any other member of
        an alias set.
        """
        names = frozenset(verdict.names)
        beside = {name: 1.0 for name in verdict.alias_set if name not in (verdict.name, *ALWAYS)}
        named = [part for part in budget.parts if part.name in names]
        least = min(named, key=lambda part: part.probability, default=None)
        if least is not None and 1 - least.probability > ALIAS_RATIO * least.probability:
            rest = candidate_name(names - {least.name} or {"none"})
            beside.setdefault(rest, (1 - least.probability) / least.probability)
        return cls(names, beside)

    def each(self) -> Iterator[tuple[str, frozenset[str], frozenset[str]]]:
        """Each other set's name, the effects that it lacks, and those that it has instead."""
        for name in self.beside:
            own = frozenset(name.split("+")) - set(ALWAYS)
            yield name, self.names - own, own - self.names


def rival_models(
    selection: Selection,
    budget: Budget,
    verdict: Verdict,
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    *,
    noise: NoiseModel,
    probability: float,
    specific_force: bool = False,
    seed: int = 0,
) -> tuple[PredictiveModel, ...]:
    """Models of the verdict, which is first, and of its rivals, at most five.

    `noise`: of single rows, with the verdict's parts in. `probability`: of the verdict; the rivals have theirs relative
    to it. What only chance tells apart is left out: it predicts the same.
    """
    known = {kind.name: kind for kind in (*EFFECTS.values(), *kinds)}
    sets, record = RivalSets.of(budget, verdict), selection.fitting.whitening.record
    found = {verdict.name: (selection.sized, frozenset[str](), probability)}
    seen = {frozenset(selection.sized.fit.model.names)}
    for name, lacking, instead in sets.each():
        added = [known[own] for own in sorted(instead) if own in known]
        if len(added) < len(instead) or len(observable(added, record)) < len(added):
            continue
        step = _with_instead(selection, lacking & set(selection.last.fit.model.names), added)
        model = step.fit.model
        if frozenset(model.names) in seen or any(model.at_limit(step.fit.z, kind.name) for kind in added):
            continue
        seen.add(frozenset(model.names))
        found[name] = (step, instead, probability * sets.beside[name])
        if len(found) == MOST_MODELS:
            break
    return tuple(
        _predictive(name, step, base, noise, new, share, specific_force, seed)
        for name, (step, new, share) in found.items()
    )


def noise_left(record: Record, errors: FloatArray, start: NoiseModel, car: GapPlant, budget: Budget) -> NoiseModel:
    """The noise of single rows, of which `errors` (channel, counted, group) are those of the `car` with all parts."""
    forces = [kind.name for kind in EFFECTS.values() if kind.own_search() == "force"]
    pushed = any(part.name in forces and part.probability >= LIKELY for part in budget.chance)
    values = {key: float(x) for key, x in car.values().items() if x.dim() == 0}
    seen = start.seen_through([type(effect) for effect in car.effects], values)
    return fit_noise(record, errors, seen, T_L=values["T_L"], priors=GUST if pushed else PRIORS).noise


def _with_instead(selection: Selection, lacking: frozenset[str], instead: Sequence[type[Effect]]) -> Step:
    """The selection's last model without the effects `lacking` and with others `instead`, sized as its own is."""
    fitting = selection.fitting
    sizing = fitting if selection.own is None or selection.judging is None else selection.judging
    fit = without_effects(fitting, selection.last.fit, lacking)
    for kind in instead:
        now = Step(fit, fitting.hold_out(fit))
        (candidate,) = candidates_for(fitting, now, [kind], None, "")
        rough = fitted(fitting, now, candidate)
        fit = fitting.fit(rough.model, rough.z[None])
    own = sizing.fit(fit.model, fit.z[None])
    return Step(own, sizing.hold_out(own))


def _predictive(
    name: str,
    step: Step,
    base: GapPlant,
    noise: NoiseModel,
    new: frozenset[str],
    probability: float,
    specific_force: bool,
    seed: int,
) -> PredictiveModel:
    fit = step.fit
    values = {key: float(x) for key, x in fit.model.values(fit.z).items() if x.dim() == 0}
    car, grade = _on_another_road(fit, plant_of(fit, base), new)
    return PredictiveModel(
        name=name,
        plant=car,
        belief=draws_of(step, seed=seed),
        noise=noise.seen_through(fit.model.effects, values),
        grade_rms=grade,
        specific_force=specific_force,
        probability=probability,
    )


def _on_another_road(fit: Fit, car: GapPlant, new: frozenset[str]) -> tuple[GapPlant, float | None]:
    """The car without the road of its drives, and the size of the one ahead, None where it has no such effect.

    Drives show how a slope varies and not its mean, which a resistance takes. So one that stands in for another effect
    (`new`) is of the usual size at least.
    """
    own = next((e for e in car.effects if isinstance(e, Integrated) and e.name in fit.model.names), None)
    if own is None:
        return car, None
    size = float(own.size_along(places(fit.model.record)))
    usual = type(own)()
    if own.name in new:
        size = max(size, float(getattr(usual, own.size)))
    return plant([usual.spaced(fit.model.record.knot_m)], baseline=car), size
