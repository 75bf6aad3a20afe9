"""The engine's posterior as the answer's hypotheses, verdict and parts: probabilities, parameters, what was tried.

A fit is implausible where the whole central 90 % of a parameter lies outside what is physically possible: the name is
then right about the shape of the gap and wrong about its origin.

Parts are named effects, and the force map of the car and other free forms as parts without a name. A part is where a
cause acts, its family, before it is a name. Its size is what it does to the car's acceleration, so that sizes of parts
compare; shares of the gap are the budget's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.average import ModelAverage, Weight, free_form_response
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name
from avtorch.gap.engine.family import FORMS, family_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.outliers import rate_onset
from avtorch.gap.engine.priors import TEMPER
from avtorch.gap.engine.search import Search
from avtorch.gap.quantity import Quantity, of_fields, unit_behind
from avtorch.gap.result.attribution import Location
from avtorch.gap.result.parameters import OwnRandom, ParameterPosterior
from avtorch.gap.simulator.effect import Effect, candidate_name, delay_effect
from avtorch.gap.simulator.plant import BASELINE, GapPlant
from avtorch.io.units import GRAVITY

ALWAYS = ("none", "unknown")
LIKELY = 0.5
"""Probability from which a part is named."""
LEAST_LISTED = 1e-4
"""Hypotheses less probable than this are left out of an answer; `none` and `unknown` never are."""
ALIAS_RATIO = 0.03
"""Hypotheses at least this probable, relative to the most probable one, are not distinguished from it."""
_DRAWS = 400  # of a map's coefficients
_HELD = 0.9  # probability that an alias set holds
_MOST_ALIASES = 6


@dataclass(frozen=True)
class Candidate:
    """A hypothesis: `"none"`, `"unknown"`, an effect, or several (`"a+b"`, in alphabetical order).

    `log_evidence` [nats] relative to `none`, without the prior over causes; None for `unknown`. `parameters` by the
    table's names, those of several as `effect.parameter`; `moved`: the baseline's `T_L` [s] and `K_L` [-] under this
    hypothesis. `onset_s` on the log's own clock; None where the effect acts from the start. `implausible`: a sentence
    for each parameter outside its physically possible range (`implausible`).
    """

    name: str
    probability: float
    log_evidence: float | None = None
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    moved: Mapping[str, Quantity] = field(default_factory=dict)
    onset_s: float | None = None
    implausible: tuple[str, ...] = ()

    @property
    def effects(self) -> tuple[str, ...]:
        """Its effects: none, one or two."""
        return () if self.name in ALWAYS else tuple(self.name.split("+"))

    def to_dict(self) -> dict[str, Any]:
        """An entry of `effects`."""
        out = of_fields(self)
        return out | plausibility(out.pop("implausible"))


def plausibility(implausible: Sequence[str]) -> dict[str, Any]:
    """The keys `plausible` and, where it is False, `plausibility` with the reasons."""
    return {"plausible": not implausible, "plausibility": " ".join(implausible) or None}


def listed_candidates(candidates: Iterable[Candidate]) -> tuple[Candidate, ...]:
    """Hypotheses as listed in an answer: improbable ones left out, renormalised to a sum of 1, most probable first."""
    given = list(candidates)
    # improbable by their share, so that weights need not be normalised
    total = math.fsum(c.probability for c in given)
    kept = [c for c in given if c.name in ALWAYS or c.probability >= LEAST_LISTED * total]
    total = math.fsum(c.probability for c in kept)
    kept.sort(key=lambda c: -c.probability)
    shares = [c.probability / total for c in kept]
    shares[0] = 1 - math.fsum(shares[1:])
    return tuple(replace(c, probability=share) for c, share in zip(kept, shares, strict=True))


@dataclass(frozen=True)
class Verdict:
    """The named causes, and the hypotheses that cannot be distinguished from them.

    `names`: `("none",)`, `("unknown",)`, or the effects, the one with the largest share of the gap first. `alias_set`:
    the hypotheses that this log cannot distinguish, including the verdict. `abstained`: it is `unknown`. `why`: one
    sentence. `partial`: effects are named, and something reproducible is left that no known effect explains.
    """

    names: tuple[str, ...]
    alias_set: tuple[str, ...]
    abstained: bool
    why: str
    partial: bool = False

    @property
    def name(self) -> str:
        """The verdict as a hypothesis's name."""
        return candidate_name(self.names)


@dataclass(frozen=True)
class Scope:
    """What a search tried: names of single effects `scored` and `not_scored`, and which `pairs`.

    `not_scored`: effects excluded by the budget or by the user. `pairs`: "all" that screening selected, "some" before
    the budget ended, or "none".
    """

    scored: tuple[str, ...] = ()
    not_scored: tuple[str, ...] = ()
    pairs: Literal["all", "some", "none"] = "all"

    @property
    def whole(self) -> bool:
        """Whether every hypothesis was tried."""
        return not self.not_scored and self.pairs == "all"

    def to_dict(self) -> dict[str, Any]:
        return {"effects": list(self.not_scored), "pairs": self.pairs}


def implausible(
    parameters: Mapping[str, Quantity],
    moved: Mapping[str, Quantity],
    effects: Iterable[type[Effect]] = (),
) -> tuple[str, ...]:
    """A sentence for each parameter whose central 90 % lies outside what is physically possible.

    `parameters` of a candidate's `effects`, by their own names or as `effect.parameter`; `moved`: T_L [s] and K_L.
    """
    each = [
        (f"{effect.name}.{p.name}", p, parameters.get(f"{effect.name}.{p.name}", parameters.get(p.name)))
        for effect in effects
        for p in (*effect.parameters, *effect.derived)
        if p.reported or p in effect.derived
    ]
    out = []
    for name, p, q in (*each, *((p.name, p, moved.get(p.name)) for p in BASELINE)):
        low, high = p.physical
        if q is None or (q.q95 >= low and q.q05 <= high):
            continue
        end = "; the effect stands in for something else." if "." in name else "."
        size = f"{name} is {q.mean:.2g}{unit_behind(p.name)}, typical {p.low:.2g} to {p.high:.2g}"
        out.append(f"{size}: possible are {low:.2g} to {high:.2g}{end}")
    return tuple(out)


class Onset(NamedTuple):
    """A time `stamp_s` [s] on the own clock of log number `log`."""

    stamp_s: float
    log: int


def onset_of(weight: Weight, name: str) -> Onset | None:
    """Since when a cause of the weight's label acts; None: from the start."""
    h = weight.examined.hypothesis
    time = next((t for e, t in h.onsets.items() if base_name(e) == name), None)
    if name == "gust" and weight.slow == "gust":
        time = weight.composition.gust_onset
    elif name == "road_grade" and weight.slow == "road_grade":
        time = weight.composition.road_onset
    elif name == "command_hold" and h.lost:
        time = _rate_onset(h, [i for i, _ in h.lost])
    elif name == "outliers" and weight.examined.outliers is not None:
        time = _rate_onset(h, weight.examined.outliers.starts.tolist())
    if time is None:
        return None
    row = int(abs(h.data.time - time).argmin())
    return Onset(float(h.data.stamp[row] + time - h.data.time[row]), int(h.data.log[row]))


def first_onset(weight: Weight, names: Sequence[str]) -> Onset | None:
    """The onset of the first of these causes that has one."""
    return next((x for x in (onset_of(weight, name) for name in names) if x is not None), None)


def _rate_onset(h: Hypothesis, rows: Sequence[int]) -> float | None:
    data = h.data
    return rate_onset(data.time[list(rows)], float(data.time[0]), float(data.time[-1]))[1]


def verdict_names(average: ModelAverage) -> tuple[str, ...]:
    """Causes that are there with a probability of a half or more, the likeliest first; where there are none,
    `("none",)` or `("unknown",)`, the more probable.

    A cause of the most probable hypothesis counts together with its aliases; any other one only in sets that also hold
    the causes for which it could stand in."""
    names = {n for label in average.probabilities for n in label.split("+")} - set(ALWAYS)
    own = set(average.label.split("+")) - set(ALWAYS)
    stands_for = {n: {m for m in own if n in aliases_of(average, m)} - {n} for n in names}

    def there(n: str) -> float:
        if n in own:
            return part_probability(average, n)
        with_all = {n, *stands_for[n]}
        return sum(p for label, p in average.probabilities.items() if with_all <= set(label.split("+")))

    likely = [n for n in names if there(n) >= LIKELY]
    if likely:
        return tuple(sorted(likely, key=lambda n: (-average.marginal(n), n)))
    return (max(ALWAYS, key=lambda n: average.probabilities[n]),)


def aliases_of(average: ModelAverage, name: str) -> tuple[str, ...]:
    """Effects that stand in the place of `name` in hypotheses of some probability, `name` first."""
    out = [name]
    top = set(average.label.split("+"))
    for label, p in average.probabilities.items():
        own = set(label.split("+"))
        others = own - top
        one_other = len(others) == 1 and not others & set(ALWAYS)
        if p >= ALIAS_RATIO and name not in own and one_other and top - {name} <= own:
            out += others
    return tuple(dict.fromkeys(out))


def part_probability(average: ModelAverage, name: str) -> float:
    """That `name`, or an effect that these drives do not tell from it, is among the causes."""
    alike = set(aliases_of(average, name))
    return min(sum(p for label, p in average.probabilities.items() if alike & set(label.split("+"))), 1.0)


def best_weight(average: ModelAverage, names: Sequence[str]) -> Weight:
    """The strongest weight of these causes; where none has just these, the strongest that has them all."""
    label = candidate_name(names)
    if label in average.best:
        return average.best[label]
    holding = [w for k, w in average.best.items() if set(names) <= set(k.split("+"))]
    return max(holding or average.best.values(), key=lambda w: w.log_weight)


def candidates_of(
    average: ModelAverage,
    kinds: Sequence[type[Effect]],
    posterior: ParameterPosterior | None,
    random: Sequence[OwnRandom] = (),
) -> tuple[list[Candidate], dict[str, ParameterPosterior]]:
    """Hypotheses of the answer, and the posteriors of their parameters by name; `posterior`: that of the verdict."""
    none = average.best["none"].evidence if "none" in average.best else 0.0
    out: list[Candidate] = []
    posteriors: dict[str, ParameterPosterior] = {}
    for label, p in average.probabilities.items():
        weight = average.best.get(label)
        if weight is None or label == "unknown":
            out.append(Candidate(label, p))
            continue
        own = posterior if posterior and posterior.weight is weight else ParameterPosterior(weight, own=random)
        posteriors[label] = own
        parameters: dict[str, Quantity] = {} if label == "none" or p < LEAST_LISTED else own.named()
        moved = own.moved()
        odd = implausible(parameters, moved, [k for k in kinds if k.name in label.split("+")])
        if label == "none":
            moved = {}
        onset = first_onset(weight, label.split("+"))
        began = None if onset is None else onset.stamp_s
        out.append(Candidate(label, p, float(weight.evidence - none), parameters, moved, began, odd))
    return out, posteriors


def verdict(average: ModelAverage, names: tuple[str, ...], known: str, partial: bool) -> Verdict:
    """The verdict of these names, with the hypotheses that hold nine tenths of the probability, and one sentence on the
    evidence and what comes next."""
    label, held, total = candidate_name(names), [candidate_name(names)], 0.0
    for other, p in average.probabilities.items():
        total += p
        held.append(other)
        if total > _HELD or len(held) > _MOST_ALIASES:
            break
    words = {"none": "that nothing is missing", "unknown": "a cause without a name"}
    rest = [(k, p) for k, p in average.probabilities.items() if k != label]
    rival = f"next likeliest, with {rest[0][1]:.3g}, is {words.get(rest[0][0], rest[0][0])}" if rest else "no rival"
    if label == "none":
        first = f"No {known} explains the log better than the baseline does"
    elif label == "unknown":
        first = f"What is missing answers to no {known}"
    elif label in average.probabilities:
        first = f"{label} has probability {average.probabilities[label]:.3g}"
    else:
        each = ", ".join(f"{n} {part_probability(average, n):.2g}" for n in names)
        first = f"Each of these causes is there with a probability of a half or more ({each})"
    return Verdict(names, tuple(dict.fromkeys(held)), label == "unknown", f"{first}; {rival}.", partial)


def given_dead_time(
    candidates: Sequence[Candidate], verdict: Verdict, baseline: GapPlant | None = None
) -> tuple[Candidate, ...] | None:
    """Hypotheses for the other causes, given that the delay is one of the causes; the most probable first.

    `none` is the delay alone, an effect's name its pair with the delay. Probabilities are proportional to those of the
    `candidates` with the delay, including the penalty of a second cause; `unknown` keeps its own. They sum to 1.
    `log_evidence` is relative to the delay alone, `parameters` are the second effect's, `moved` is with both effects.

    None where the baseline is more than bare GLVD, the verdict does not contain the delay, or no pair was tried.
    """
    delay = delay_effect().name
    late = [c for c in candidates if delay in c.effects]
    alone = next((c for c in late if c.name == delay), None)
    if delay not in verdict.names or alone is None or len(late) < 2 or (baseline is not None and baseline.effects):
        return None
    total = sum(c.probability for c in late)
    unknown = next((c.probability for c in candidates if c.name == "unknown"), 0.0)
    out = [Candidate("unknown", unknown)]
    for c in late:
        second = "+".join(name for name in c.effects if name != delay)
        own = {k.removeprefix(f"{second}."): q for k, q in c.parameters.items() if k.startswith(f"{second}.")}
        out.append(
            replace(
                c,
                name=second or "none",
                probability=(1 - unknown) * c.probability / total,
                log_evidence=(c.log_evidence or 0.0) - (alone.log_evidence or 0.0),
                parameters=own if second else {},
            )
        )
    return tuple(sorted(out, key=lambda c: -c.probability))


# parts --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class AnswerPart:
    """A part of what the simulator lacks, an entry of `parts` in `diagnosis.json`.

    `name` of an effect, None of a free form; its `family`; `form` of a free one.
    `size_mps2`: root mean square of what it adds to the acceleration or to the rate of the speed, None where that is
    not measured. `where` a free form acts, in time, speed, command, frequency.
    """

    name: str | None
    family: str
    form: str | None
    size_mps2: Quantity | None
    probability: float
    where: tuple[Location, ...] = ()


@dataclass(frozen=True, eq=False)
class UnnamedResponse:
    """What a free `form` beside a `hypothesis` does: `change` (channel, frame, bin), and `size_mps2` of it, the root
    mean square over the rows of the channel that shows it most."""

    form: str
    hypothesis: Hypothesis
    change: FloatArray = field(repr=False)

    @property
    def size_mps2(self) -> float:
        data = self.hypothesis.data
        rows = max(data.frame_count * data.frame_rows, 1)
        return float(np.sqrt((self.change**2).sum((1, 2)).max() / rows))


def unnamed_response(average: ModelAverage, weight: Weight, search: Search) -> UnnamedResponse | None:
    """What the likeliest free form does beside the weight's hypothesis, if one is likely, or stands for `unknown`."""
    if not average.parts:
        return None
    form, probability = max(average.parts.items(), key=lambda kv: kv[1])
    if weight.label == "unknown":
        form = weight.part or form
    elif sum(p for f, p in average.parts.items() if family_of(f) == family_of(form)) < LIKELY:
        return None
    change = free_form_response(weight.examined, search, form) if probability >= LEAST_LISTED else None
    return None if change is None else UnnamedResponse(form, weight.examined.hypothesis, change)


def parts_of(
    average: ModelAverage,
    names: Sequence[str],
    posterior: ParameterPosterior,
    seed: int = 0,
    unnamed: UnnamedResponse | None = None,
    where: tuple[Location, ...] = (),
) -> tuple[AnswerPart, ...]:
    """The named parts of the verdict, in its order, then the force map and the other free forms, the likeliest first;
    `posterior`: of the verdict's weight; `unnamed`: what the likeliest free form does, and `where`."""
    parts = [
        AnswerPart(name, family_of(name), None, _size(posterior, name), part_probability(average, name))
        for name in names
        if name not in ("none", "unknown")
    ]
    present = min(sum(average.force_maps.values()), 1.0)  # which rounding may exceed
    having = [w for w in average.best.values() if w.examined.hypothesis.force is not None]
    if having and present >= LEAST_LISTED:
        h = max(having, key=lambda w: (w is posterior.weight, w.log_weight)).examined.hypothesis
        form = max(average.force_maps, key=lambda name: average.force_maps[name])
        parts.append(AnswerPart(None, "force map", form, map_size(h, seed), present))
    for form, probability in sorted(average.parts.items(), key=lambda kv: -kv[1]):
        if probability >= LEAST_LISTED:
            own = unnamed is not None and unnamed.form == form
            size = Quantity(unnamed.size_mps2, 0.0, *2 * [unnamed.size_mps2]) if own and unnamed is not None else None
            parts.append(AnswerPart(None, family_of(form), form, size, probability, where if own else ()))
    return tuple(parts)


def said_of_unnamed(parts: Sequence[AnswerPart], unknown: bool = False, epoch_s: float = 0.0) -> str:
    """A sentence on the likely part without a name, or on what an `unknown` cause is most like; else nothing. Times
    count from `epoch_s`."""
    free = [p for p in parts if p.name is None]
    family = max(free, key=lambda p: p.probability).family if free else ""
    own = [p for p in free if p.family == family]
    probability = min(sum(p.probability for p in own), 1.0)
    if not own or (probability < LIKELY and not unknown):
        return ""
    part = max(own, key=lambda p: (p.size_mps2 is not None, p.probability))
    words = (
        f"{FORMS[part.form][1]} ({family})"
        if part.form in FORMS
        else f"the force map {part.form}, the car's force beyond K u"
    )
    size = [] if part.size_mps2 is None else [f"{part.size_mps2.mean:.2g} m/s² in the root mean square"]
    what = ", ".join([words, *size, *(place.words(epoch_s) for place in part.where)])
    return f"{'It is most like' if unknown else 'A part without a name is'} {what} (probability {probability:.2g})."


def map_size(h: Hypothesis, seed: int = 0) -> Quantity:
    """Root mean square [m/s²] over the drive's rows of the force beyond K u, by Laplace's approximation."""
    assert h.force is not None
    n, b = h.force.count, h.force_coefficients
    covariance = np.linalg.inv(h.information)[-n:, -n:] / TEMPER
    sizes, turn = np.linalg.eigh(0.5 * (covariance + covariance.T))
    random = np.random.default_rng(seed).standard_normal((_DRAWS, n))
    draws = b + random * np.sqrt(np.maximum(sizes, 0.0)) @ turn.T
    return Quantity.of_draws(np.sqrt(np.einsum("dk,kl,dl->d", draws, h.force.gram, draws)))


def _size(posterior: ParameterPosterior, name: str) -> Quantity | None:
    h = posterior.hypothesis
    own = posterior.by_effect().get(name, {})
    if name == "gust" and "sd_mps2" in own:
        return own["sd_mps2"]
    if name == "road_grade" and "grade_rms" in own:
        return own["grade_rms"].scaled(GRAVITY)
    effect = next((e for e in h.effects if base_name(e) == name), None)
    if effect is None:
        return None
    does = [a - b for a, b in zip(h.rows(), h.without(effect).rows(), strict=True)]
    size = max(float(np.sqrt((x**2).mean())) for x in does)
    coordinates = EFFECTS[effect].coordinates
    if not coordinates:
        return Quantity.of_draws(size)
    name = coordinates[0].name  # relative to whose value at the fit draws are
    neutral = float(h.neutral[INDEX[name]])
    away = np.abs(posterior.draws[name].reshape(-1) - neutral)
    return Quantity.of_draws(size * away / max(abs(h[name] - neutral), 1e-12))
