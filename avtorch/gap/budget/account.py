"""Which analysis supplies the verdict: the likelihood where it holds, selection on held-out blocks where it does not.

The likelihood is the sharper of the two where its equations hold: it names a cause that no rollout shows yet. Where it
answers `unknown`, or calls for a random force that swallows whatever is reproducible, its noise model does not hold.
Colour alone is no cause, so the blocks that were held out decide then, under a noise of free spectrum.

With acceleration alone no second channel contradicts the likelihood: behind ordinary recorders it named 16 parts at a
mean probability of 0.98, of which 7 were there. There its effects stay only where held-out blocks confirm all of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from avtorch.errors import InputError
from avtorch.gap.answer.budget import LIKELY, MATERIAL, Budget, ChancePart, Part, own_onset, percent
from avtorch.gap.answer.plausibility import implausible
from avtorch.gap.answer.verdict import ALWAYS, Candidate, Verdict, candidate_name
from avtorch.gap.budget.analysis_record import AnalysisRecord
from avtorch.gap.budget.forward_selection import MOST_PARTS, baseline_noise, select
from avtorch.gap.budget.gap_budget import budget_of, by_chance
from avtorch.gap.budget.given_effects import given_effects
from avtorch.gap.budget.likely_parts import likely_parts
from avtorch.gap.budget.one_channel import with_untested
from avtorch.gap.budget.part_odds import PartOdds
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.budget.share_of_noise import share_of_noise
from avtorch.gap.budget.share_order import largest_first
from avtorch.gap.budget.unexplained_places import placed
from avtorch.gap.quantity import Quantity
from avtorch.gap.search.checkpoint import Checkpoint
from avtorch.gap.search.fitted_model import FittedModel
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant
from avtorch.io import Log

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Account:
    """A budget with the `verdict` and the `candidates` that agree with it.

    `held_out`: the parts were selected on held-out blocks, with the steps in `selection`; else by the likelihood.
    """

    budget: Budget
    selection: Selection
    candidates: tuple[Candidate, ...]
    verdict: Verdict
    held_out: bool


def account(
    logs: Sequence[Log],
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    candidates: Sequence[Candidate],
    verdict: Verdict,
    winner: FittedModel | None,
    *,
    material: float = MATERIAL,
    most: int = MOST_PARTS,
    seed: int = 0,
    progress: Progress | None = None,
    checkpoint: Checkpoint | None = None,
) -> Account | None:
    """The account of these drives, given the likelihood's `candidates`, its `verdict`, and the fit that won.

    `checkpoint`: the search's own, which keeps the steps of a selection, too.

    None where the drives are too short to hold out blocks.
    """
    record = _record(logs)
    if record is None:
        return None
    if progress is not None:
        progress("budget", 0, 1)
    fitting, bare = baseline_noise(record, base)
    named = [] if winner is None else list(winner.hypothesis.effects)
    values = {} if winner is None else winner.values
    begun = given_effects(fitting, bare, named, values=values, onsets=_onsets(winner, logs))
    epoch, options = logs[0].epoch_s, {"material": material, "seed": seed}

    def selected() -> Selection:
        found = select(record, base, kinds, begun=begun, most=most, progress=progress, checkpoint=checkpoint)
        return likely_parts(found, material, seed=seed)

    holds = winner is not None and not winner.blown
    selection = None
    if holds and named and not record.has_speed:
        selection = selected()
        holds = {kind.name for kind in named} <= {step.entered for step in selection.steps}
        winner = winner if holds else None
    if winner is not None and holds:
        selection = largest_first(begun, 0.0)
        budget = _as_adequate(budget_of(selection, epoch_s=epoch, **options), candidates)
        budget = _by_likelihood(budget, candidates, verdict, named, winner, epoch if len(logs) == 1 else None)
        budget = replace(budget, chance=_chance(candidates, verdict, winner, budget.unexplained.probability, selection))
        return Account(budget, selection, tuple(candidates), _verdict(budget, verdict), held_out=False)
    if selection is None:
        selection = selected()
    budget = budget_of(selection, epoch_s=epoch, **options)
    rest = placed(budget.unexplained, selection, epoch_s=epoch)
    chance = _all_chance(selection, base, kinds, candidates, verdict, winner, budget)
    budget = with_untested(replace(budget, unexplained=rest, chance=chance), selection, logs, kinds)
    held_out = tuple(shared_out(candidates, budget, kinds))
    return Account(budget, selection, held_out, _verdict(budget, verdict), held_out=True)


def _record(logs: Sequence[Log]) -> AnalysisRecord | None:
    try:
        return AnalysisRecord.for_budget(logs)
    except InputError:
        return None


def divisible(logs: Sequence[Log]) -> bool:
    """Whether these drives are long enough to hold out blocks, so that there is an account."""
    return _record(logs) is not None


def _onsets(winner: FittedModel | None, logs: Sequence[Log]) -> dict[str, float]:
    """When the winner's effects set in [s from the log's start]; of several drives nothing is said."""
    if winner is None or winner.onset is None or len(logs) > 1:
        return {}
    record = winner.hypothesis.record
    time = float(record.time[record.source[winner.onset]])
    return {e.name: time for e in winner.hypothesis.effects if e.own_onset is None}


def _as_adequate(budget: Budget, candidates: Sequence[Candidate]) -> Budget:
    """The budget where the likelihood holds: what its test of adequacy does not see is taken as noise."""
    doubt = next(c.probability for c in candidates if c.name == "unknown")
    rest = budget.unexplained
    return replace(budget, unexplained=replace(rest, material=False, probability=min(rest.probability, doubt)))


# by the likelihood -------------------------------------------------------------------------------------------------
def _by_likelihood(
    budget: Budget,
    candidates: Sequence[Candidate],
    verdict: Verdict,
    named: Sequence[type[Effect]],
    winner: FittedModel,
    epoch_s: float | None,
) -> Budget:
    """The budget whose parts have the likelihood's probabilities, aliases, parameters and onset.

    `epoch_s`: the log's start on its own clock; None: several logs.
    """
    by_name = {kind.name: kind for kind in named}
    own = next(c for c in candidates if c.name == verdict.name)
    left = budget.unexplained.probability
    parts = tuple(
        _part(part, by_name[part.name], own, candidates, verdict, winner, left, epoch_s) for part in budget.parts
    )
    return replace(budget, parts=parts)


def restated(budget: Budget, candidate: Candidate) -> Budget:
    """The budget with the parameters of the likelihood's winner as estimated anew, such as from draws."""

    def parameters(name: str, before: Mapping[str, Quantity] | None) -> Mapping[str, Quantity]:
        return _own_parameters(name, candidate) or before or {}

    parts = tuple(replace(p, parameters=parameters(p.name, p.parameters)) for p in budget.parts)
    chance = tuple(replace(p, parameters=parameters(p.name, p.parameters)) for p in budget.chance)
    return replace(budget, parts=parts, chance=chance)


def _part(
    part: Part,
    kind: type[Effect],
    own: Candidate,
    candidates: Sequence[Candidate],
    verdict: Verdict,
    winner: FittedModel,
    left: float,
    epoch_s: float | None,
) -> Part:
    aliases = _aliases(part.name, verdict)
    parameters = _own_parameters(part.name, own)
    late = kind.own_onset is not None or winner.onset is not None
    onset = own.onset_s if late else None
    if onset is None:  # as of a pair, which has no onset of its own
        onset = own_onset(kind, parameters, epoch_s)
    return replace(
        part,
        alias_set=aliases,
        probability=_probability(aliases, candidates, left),
        parameters=parameters or part.parameters,
        onset_s=onset,
        plausible=not implausible(parameters, {}, [kind]),
    )


def _chance(
    candidates: Sequence[Candidate],
    verdict: Verdict,
    winner: FittedModel | None,
    left: float,
    selection: Selection,
) -> tuple[ChancePart, ...]:
    """The verdict's effects that chance decides."""
    if winner is None:
        return ()
    random = list(winner.searched) + ([] if winner.by_chance is None else [type(winner.by_chance.law.effect)])
    own = next(c for c in candidates if c.name == verdict.name)
    out = []
    for kind in random:
        parameters = _own_parameters(kind.name, own)
        probability = _probability(_aliases(kind.name, verdict), candidates, left)
        share = share_of_noise(kind, winner, selection)
        out.append(ChancePart(kind.name, probability, share, parameters, not implausible(parameters, {}, [kind])))
    return tuple(sorted(out, key=lambda part: -part.probability))


def _all_chance(
    selection: Selection,
    base: GapPlant,
    kinds: Sequence[type[Effect]],
    candidates: Sequence[Candidate],
    verdict: Verdict,
    winner: FittedModel | None,
    budget: Budget,
) -> tuple[ChancePart, ...]:
    """The residuals', which no part explains any more, and the likelihood's besides."""
    seen = by_chance(selection, base, kinds)
    own = {part.name for part in seen}
    told = _chance(candidates, verdict, winner, budget.unexplained.probability, selection)
    others = [x for x in told if x.name not in own]
    return tuple(sorted([*others, *seen], key=lambda part: -part.probability))


def _aliases(name: str, verdict: Verdict) -> tuple[str, ...]:
    """Effects that can take the place of `name` in the verdict, itself first."""
    others = [n for n in verdict.names if n != name]
    alike = [set(alias.split("+")) - set(others) for alias in verdict.alias_set if alias not in ALWAYS]
    swapped = sorted(
        next(iter(left))
        for alias, left in zip([a for a in verdict.alias_set if a not in ALWAYS], alike, strict=True)
        if len(left) == 1 and len(alias.split("+")) == len(verdict.names) and name not in left
    )
    return (name, *swapped)


def _probability(aliases: Sequence[str], candidates: Sequence[Candidate], left: float) -> float:
    """That one of them is there: of all hypotheses that hold one.

    `left`: the probability that something reproducible is left; as far as nothing is, the cause is not an unknown one.
    """
    weights = {c.name: c.probability * (left if c.name == "unknown" else 1.0) for c in candidates}
    held = math.fsum(weights[c.name] for c in candidates if set(aliases) & set(c.effects))
    return min(held / math.fsum(weights.values()), 1.0)


def _own_parameters(name: str, candidate: Candidate) -> Mapping[str, Quantity]:
    if candidate.effects == (name,):
        return candidate.parameters
    return {key.partition(".")[2]: q for key, q in candidate.parameters.items() if key.partition(".")[0] == name}


# by held-out blocks ------------------------------------------------------------------------------------------------
def shared_out(candidates: Sequence[Candidate], budget: Budget, kinds: Sequence[type[Effect]]) -> list[Candidate]:
    """The hypotheses, with what `none` and `unknown` held shared out as held-out blocks decide.

    The likelihood cannot say how probable a hypothesis is whose noise does not hold; what it left to `unknown` goes to
    the parts that held-out blocks select, as far as these are sure, and to `unknown` as far as something material is
    left besides. Where they select nothing, or wrongly, some drives have a cause that they are too short or too calm to
    show; each effect by itself is as likely to be that. Some have one that no effect describes (`PartOdds`). Where
    nothing is selected and something material is left, it is either of these two, in the same proportion.
    """
    free = math.fsum(c.probability for c in candidates if c.name in ALWAYS)
    left, odds = budget.unexplained.probability, PartOdds.read()
    name = candidate_name(budget.names)
    hidden = [c for c in candidates if len(c.effects) == 1 and c.name not in (*ALWAYS, name)]
    if budget.names:
        sure = min(p.probability for p in (*budget.parts, *budget.chance) if p.name in budget.names)
        none, unknown, other = odds.none_wrong, odds.unknown_wrong, free * (1 - sure)
        shares = {"unknown": free * sure * left, "none": 0.0, name: free * sure * (1 - left)}
        none = none if hidden else 1 - unknown
    else:
        none, unknown, other = odds.none_unnamed, odds.unknown_unnamed, free
        shares = {"unknown": 0.0, "none": 0.0}
        none = none if hidden else 1 - unknown
        # as far as something material is left there is a cause: an effect that does not show yet, or one of no table
        none, unknown = (1 - left) * none, unknown * (1 - left + left / (1 - none))
    shares["unknown"] += other * unknown
    shares["none"] += other * none
    shares |= {c.name: c.probability + other * (1 - none - unknown) / len(hidden) for c in hidden}
    out = [replace(c, probability=shares.get(c.name, c.probability)) for c in candidates if c.name != name]
    if budget.names:
        before = next((c for c in candidates if c.name == name), None)
        known = 0.0 if before is None else before.probability
        chosen = _selected(budget, name, min(known + shares[name], 1.0), kinds)
        out.append(replace(chosen, log_evidence=None if before is None else before.log_evidence))
    return out


def _selected(budget: Budget, name: str, probability: float, kinds: Sequence[type[Effect]]) -> Candidate:
    """The named parts as a hypothesis."""
    parts = [p for p in (*budget.parts, *budget.chance) if p.probability >= LIKELY]
    alone = len(parts) == 1
    parameters = {key if alone else f"{p.name}.{key}": q for p in parts for key, q in (p.parameters or {}).items()}
    onsets = [p.onset_s for p in budget.parts if p.probability >= LIKELY and p.onset_s is not None]
    own = [k for k in kinds if k.name in budget.names]
    odd = implausible(parameters, budget.repaired, own)
    return Candidate(name, probability, None, parameters, budget.repaired, min(onsets, default=None), odd)


# the verdict -------------------------------------------------------------------------------------------------------
def _verdict(budget: Budget, by_likelihood: Verdict) -> Verdict:
    """The budget's names, with the sets that these drives cannot distinguish from them."""
    names = budget.verdict
    if set(names) == set(by_likelihood.names):
        return replace(by_likelihood, names=names, partial=budget.partial)
    own = candidate_name(names)
    swapped = [
        candidate_name({*names} - {part.name} | {alias})
        for part in (*budget.parts, *budget.chance)
        if part.name in names
        for alias in part.alias_set
        if alias not in names
    ]
    return Verdict(names, (own, *dict.fromkeys(swapped)), own == "unknown", _why(budget), budget.partial)


def _why(budget: Budget) -> str:
    if not budget.names:
        if budget.unexplained.material:
            return (
                "On parts of the drive not used for fitting no known effect reduces the error, though part of it is "
                "reproducible."
            )
        share = percent(PartOdds.read().none_unnamed)
        return (
            "What is left is noise: commands, speed and place do not predict it on parts of the drive not used for "
            f"fitting. Of simulated drives that say so {share} have no cause, the others one too weak to show, or one "
            "that is not in the table of effects."
        )
    count = len(budget.names)
    chosen = "This effect was chosen because it" if count == 1 else f"These {count} effects were chosen because they"
    return f"{chosen} best predict{'s' if count == 1 else ''} parts of the drive not used for fitting."
