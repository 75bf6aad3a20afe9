"""The average of visited hypotheses: what each may have beside its effects, and what that is called.

Beside its effects every hypothesis may have a slow random force (gust or road), outliers of the accelerometer, and a
free form of some family; all are valued in nats of the same likelihood. Each such composition supports labels. Its own
is its effects by name. But an effect may be an error of the shape of the others, and then the label is without it; a
free form may be that, too, or a cause without a name, `unknown`. A free form beside names is one more cause, without a
name; or there is a single unknown cause, which the names and the form describe together, and a name that only
describes costs less than one that is a cause. If the base has a force map, the map is such a part, and the label is
`unknown` where nothing else is named; where named effects explain as much as the map, they win. Labels add up what
supports them:

    P(label) ~ sum exp(TEMPER (log evidence + log odds))
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.coordinates import EFFECTS, INDEX, base_name
from avtorch.gap.engine.family import family_of
from avtorch.gap.engine.free_forms import (
    FreeFormFit,
    explained,
    explained_or_late,
    linear_forms,
    mirror_columns,
    sensor_form,
    wandering,
)
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.likelihood import log_sum
from avtorch.gap.engine.outliers import Outliers, sensor_outliers
from avtorch.gap.engine.priors import (
    EFFECT_NATS,
    EFFECT_NATS_ALONE,
    FAINT_OF_RANGE,
    OUTLIER_NATS,
    SLOW_FORCE_NATS,
    TEMPER,
    TRIED_NATS,
    UNKNOWN_NATS,
    WITHIN_NATS,
)
from avtorch.gap.engine.pulling_lags import PullingLags, pulling_lags
from avtorch.gap.engine.roughness import SIGNS, roughness
from avtorch.gap.engine.search import Search
from avtorch.gap.engine.shape_error import relative_size, shape_likelihood, shape_log_odds, shape_log_prior
from avtorch.gap.engine.slow_forces import (
    SlowForces,
    SlowOnset,
    cycle_response,
    sensors_by_frame,
    slow_forces,
    slow_onset,
)
from avtorch.gap.simulator.effect import EFFECTS as TABLE

_EXAMINED = 8  # hypotheses that are examined in full
_LINEAR = frozenset({"dead_time", "second_order_actuator", "sensor_lag", "speed_lag", "driveline_oscillation"})
_FAINT_GUST = FAINT_OF_RANGE * TABLE["gust"].parameters[0].low
_LARGE_OF_COMMAND = 0.2  # a slow force has a name, with one channel, from this share of the command's spread on
_LEAST_LISTED = 1e-4
_LEAST_FORM_NATS = -6.0  # a free form that loses more is not listed
Key = TypeVar("Key", str, frozenset[str])

SLOW = ("none", "gust", "road_grade")


@dataclass(frozen=True, eq=False)
class Composition:
    """A hypothesis with one free form, or none (`form` empty), and its slow forces.

    `nats` of the form over none; `relative`: size of what it does over the effects' response. `total` (slow force):
    evidence [nats] with process noise alone, a gust, or a road, errors of shape integrated out. `slow`: at the
    likeliest error of shape. `gust_onset`, `road_onset` [s] or None.
    """

    form: str
    nats: float
    relative: float
    total: Mapping[str, float]
    slow: SlowForces
    gust_onset: float | None = None
    road_onset: float | None = None


@dataclass(frozen=True, eq=False)
class Examined:
    """A visited `hypothesis` and what it may have beside its effects.

    `outliers`: of the accelerometer, None without one. `beside` maps an
    effect to the relative size of what it adds to the others' response, and to the nats that it gains beside them.
    `mirror` [nats]: gain of linear dynamics that run backwards in time.
    """

    hypothesis: Hypothesis
    compositions: tuple[Composition, ...]
    outliers: Outliers | None
    beside: Mapping[str, tuple[float, float]]
    mirror: float = 0.0


@dataclass(frozen=True, eq=False)
class Weight:
    """One composition under one label: `log_weight` [nats] before tempering, `evidence` the same without odds.

    `part`: the free form that is a part without a name, or a cause without one; empty where there is none, or where it
    is an error of shape.
    """

    label: str
    log_weight: float
    evidence: float
    examined: Examined = field(repr=False)
    composition: Composition = field(repr=False)
    slow: str
    outliers: bool
    part: str = ""

    @property
    def families(self) -> frozenset[str]:
        """Of what is there under this label."""
        names = [n for n in self.label.split("+") if n not in ("none", "unknown")]
        names += [self.part] if self.part else []
        return frozenset([*map(family_of, names), *(["force map"] if self.examined.hypothesis.force else [])])

    @property
    def process_noise(self) -> float:
        """White jerk behind the actuator [m/s³/√Hz]: what is left of it where there is a gust."""
        slow = self.composition.slow
        if self.composition.form == "cycle":
            return slow.process_noise_beside_cycle
        return slow.process_noise_beside_gust if self.slow == "gust" else slow.process_noise


@dataclass(frozen=True, eq=False)
class ModelAverage:
    """Probabilities of labels ("none", "unknown", effects joined by "+" in alphabetical order), and what supports them.

    `probabilities` sum to 1, the most probable first; `best`: the strongest support of each label. `force_maps`:
    probability of each form of a force map in the base, by its name; `parts`: of each free form as a part without a
    name, or as what `unknown` stands for; `families`: that something of a family is there, with a name or without.
    """

    probabilities: Mapping[str, float]
    best: Mapping[str, Weight]
    examined: tuple[Examined, ...]
    force_maps: Mapping[str, float] = field(default_factory=dict)
    parts: Mapping[str, float] = field(default_factory=dict)
    families: Mapping[str, float] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """The most probable label."""
        return next(iter(self.probabilities))

    def marginal(self, effect: str) -> float:
        """Probability that this effect is among the causes."""
        return sum(p for label, p in self.probabilities.items() if effect in label.split("+"))


def examined_sets(search: Search) -> list[Examined]:
    """The best visited sets, the base, and the best single effects, examined."""
    ranked = sorted(search.visited.values(), key=lambda h: -h.score)
    chosen = [h for h in ranked if h.score > ranked[0].score - WITHIN_NATS][:_EXAMINED]
    single = [h for h in ranked if len(h.effects) == len(search.base.effects) + 1]
    chosen += [h for h in (search.visited[search.key(search.base)], *single[:2]) if h not in chosen]
    return [examine(h, search) for h in chosen]


def examine(h: Hypothesis, search: Search) -> Examined:
    """Everything that may be beside the effects of one hypothesis, in nats."""
    data = h.data
    exact = h.evidence - log_sum(h.shape_log)
    lags = pulling_lags(h)
    compositions = [_composed(h, "", 0.0, h.residual, exact, lags)]
    mirror = 0.0
    if not h.alone:  # with one channel no free form can be told from the base's own dynamics and slow force
        forms, mirror = _free_forms(h, search) if _acts(h) else ({}, _echo(h, "linear"))
        left = {"": h.residual} | {name: x.residual for name, x in forms.items() if x.residual is not None}
        compositions += [
            _composed(h, name, forms[name].nats, residual, exact, lags, least=_LEAST_FORM_NATS)
            for name, residual in left.items()
            if name
        ]
        plain = compositions[0]
        late = _late_forces(h, h.residual, lags)
        compositions = [_set_in(c, late, _late_forces(h, left[c.form], lags)) for c in compositions if c is not None]
        if forms and plain is not None:
            # beside slow forces that act throughout: what is louder from a time on is louder in some frames, too
            compositions += [_cycle(h, plain), *(_rough(h, plain, form) for form in SIGNS)]
    beside = {}
    for e in h.effects if len(h.effects) > 1 else []:
        rest = search.without(h, e)
        if rest is None or e.startswith("~"):
            continue
        size = math.inf
        if rest.effect_energy is not None:
            size = relative_size(data, h.covariance, h.predicted - rest.predicted, rest.effect_energy)
        beside[base_name(e)] = (min(size, 99.0), h.evidence - rest.evidence)
    h.jacobian = None
    outliers = sensor_outliers(h) if data.accel is not None else None
    return Examined(h, tuple(c for c in compositions if c is not None), outliers, beside, mirror)


def _free_forms(h: Hypothesis, search: Search) -> tuple[dict[str, FreeFormFit], float]:
    """Each free form beside a hypothesis, and the nats of the mirrored linear bank."""
    # where bases have a map, it is there that a map stands beside these effects
    others = {name: form for name, form in linear_forms(h).items() if name != "map" or not search.map_bases}
    forms = {name: explained(h, form) for name, form in others.items()} | wandering(h)
    forms["sensor"] = explained_or_late(h, sensor_form(h))
    mirrors = {
        name: _echo(h, name)
        for name in ("linear", "sided", "sensor")
        if forms[name].nats > 0 or (name == "linear" and _LINEAR & set(h.names))
    }
    for name, echo in mirrors.items():
        forms[name] = forms[name]._replace(nats=forms[name].nats - echo)
    return forms, mirrors.get("linear", 0.0)


def _echo(h: Hypothesis, form: str) -> float:
    """Nats of the mirrored bank of a form."""
    return max(explained(h, mirror_columns(h, form)).nats, 0.0)


def free_form_response(x: Examined, search: Search, form: str) -> FloatArray | None:
    """What a free form explains of the residual beside a hypothesis, with all parameters moved again: coefficients
    (channel, frame, bin); None where it tells nothing."""
    h = x.hypothesis
    if form == "cycle":
        return cycle_response(h.data, h.residual, x.compositions[0].slow)
    forms = {form: roughness(h, form)} if form in SIGNS else _free_forms(h, search)[0]
    left = forms[form].residual if form in forms else None
    return None if left is None else h.residual - left


def average(
    examined: list[Examined],
    *,
    effects: Collection[str] | None = None,
    most: int | None = None,
    prior: Mapping[str, float] | None = None,
) -> ModelAverage:
    """The model average over examined hypotheses. `effects`: names that a label may hold; `most` of them; `prior`:
    weights of causes by name, 1 where not given; of `"pair"` for several at once."""
    allowed = None if effects is None else {*effects, "none", "unknown"}
    named = [
        x.hypothesis
        for x in examined
        if x.hypothesis.force is None
        and (allowed is None or set(x.hypothesis.names) <= allowed)
        and (most is None or len(x.hypothesis.names) <= most)
    ]
    weights = [w for x in examined if not _named_as_well(x.hypothesis, named) for w in _weights(x, examined)]
    if effects is not None or most is not None:
        # what chance decides and nobody asked for is noise
        nameless = set() if effects is None else {*SLOW, "outliers"} - {*effects}
        weights = [replace(w, label=_renamed(w, nameless)) for w in weights]
        weights = [
            w
            for w in weights
            if (allowed is None or set(w.label.split("+")) <= allowed)
            and (most is None or len(w.label.split("+")) <= most)
        ]
    total: dict[str, list[float]] = {}
    best: dict[str, Weight] = {}
    bases: dict[str, list[float]] = {}
    forms: dict[str, list[float]] = {}
    families: dict[frozenset[str], list[float]] = {}
    for w in weights:
        given = _given(w.label, prior or {})
        total.setdefault(w.label, []).append(TEMPER * w.log_weight + given)
        force = w.examined.hypothesis.force
        bases.setdefault("" if force is None else force.name, []).append(total[w.label][-1])
        forms.setdefault(w.part, []).append(total[w.label][-1])
        families.setdefault(w.families, []).append(total[w.label][-1])
        if w.label not in best or best[w.label].log_weight < w.log_weight:
            best[w.label] = w
    # none and unknown are always listed, be it as the least
    shares = {"none": 0.0, "unknown": 0.0} | _shares(total)
    listed = {k: max(v, _LEAST_LISTED) for k, v in shares.items() if v > _LEAST_LISTED or k in ("none", "unknown")}
    whole = sum(listed.values())
    chances = {k: v / whole for k, v in sorted(listed.items(), key=lambda kv: -kv[1])}
    together = _shares(families)
    each = {name: sum(p for own, p in together.items() if name in own) for own in together for name in own}
    return ModelAverage(chances, best, tuple(examined), _shares(bases), _shares(forms), each)


# inside ---------------------------------------------------------------------------------------------------------------
def _renamed(w: Weight, nameless: Collection[str]) -> str:
    """The weight's label without names; with a force map, what has no other name is unknown."""
    left = "+".join(n for n in w.label.split("+") if n not in nameless)
    return left or ("none" if w.examined.hypothesis.force is None else "unknown")


def _shares(logs: Mapping[Key, list[float]]) -> dict[Key, float]:
    """Probabilities of what is not empty, from logarithms of weights by what they have."""
    each = {name: log_sum(x) for name, x in logs.items()}
    whole = log_sum(list(each.values()))
    return {name: math.exp(x - whole) for name, x in each.items() if name}


def _given(label: str, prior: Mapping[str, float]) -> float:
    """Logarithm of the user's weight of a label: the product of its causes', times that of `"pair"` for several."""
    names = label.split("+")
    weights = [prior.get(name, 1.0) for name in names] + ([prior.get("pair", 1.0)] if len(names) > 1 else [])
    return sum(math.log(max(x, 1e-300)) for x in weights)


def _acts(h: Hypothesis) -> bool:
    """Whether no effect of the set is faint: beside next to nothing, a free form is none of its kind."""
    return all(e.startswith("~") or EFFECTS[e].size(h.values, h.neutral) > 1 for e in h.effects)


def _from_the_start(h: Hypothesis) -> np.ndarray:
    """Values (parameter,) of what acts through the whole drive."""
    values = h.values.copy()
    for e in h.onsets:
        for c in EFFECTS[e].coordinates:
            values[INDEX[c.name]] = h.neutral[INDEX[c.name]]
    return values


def _composed(
    h: Hypothesis, form: str, nats: float, residual: np.ndarray, exact: float, lags: PullingLags, least: float = -np.inf
) -> Composition | None:
    """Slow forces beside a free form that has left `residual`, at every error of the effects' shape."""
    data = h.data
    shape = h.shape if residual is h.residual else shape_likelihood(data, residual, h.effect_energy)
    sensors = sensors_by_frame(h)
    logs = np.zeros(1) if shape is None else shape.nats + shape_log_prior(h.effects)
    over = nats + log_sum(logs) - log_sum(h.shape_log)
    if form and over < least:
        return None
    asked = not form and not h.alone
    kinds = (*SLOW, "cycle") if asked else SLOW
    parts: dict[str, list[float]] = {name: [] for name in kinds}
    best: tuple[float, SlowForces] | None = None
    for k, value in enumerate(logs):
        if value < logs.max() - 6:
            continue
        given = None if shape is None else (np.ascontiguousarray(shape.covariances[k]), shape.counts[k])
        found = slow_forces(data, residual, _from_the_start(h), given, lags, sensors=sensors, cycle=asked)
        free = -0.5 * float((found.counts * (np.linalg.slogdet(found.covariance)[1] + data.channel_count)).sum())
        total = exact + nats + float(value) + found.log_likelihood - free
        for name, more in zip(kinds, (0.0, found.gust, found.road, found.cycle), strict=False):
            parts[name].append(total + more)
        if best is None or parts["gust"][-1] > best[0]:
            best = parts["gust"][-1], found
    assert best is not None
    relative = 99.0
    if form and residual is not h.residual and h.effect_energy is not None:
        relative = relative_size(data, h.covariance, h.residual - residual, h.effect_energy)
    return Composition(form, over, relative, {k: log_sum(v) for k, v in parts.items()}, best[1])


def _cycle(h: Hypothesis, plain: Composition) -> Composition:
    """A force that swings at one frequency in the place of the slow forces of a `plain` composition, as a form."""
    relative = 99.0
    total = plain.total["cycle"] - (_FAINT_GUST / plain.slow.cycle_sd) ** 2
    if h.effect_energy is not None:
        done = cycle_response(h.data, h.residual, plain.slow)
        relative = relative_size(h.data, h.covariance, done, h.effect_energy)
    return Composition("cycle", total - plain.total["none"], relative, {"none": total}, plain.slow)


def _rough(h: Hypothesis, plain: Composition, form: str) -> Composition | None:
    """A force that is there while braking, or driving, beside the slow forces of a `plain` composition.

    Errors of the effects' shape are energy in the same frames: it counts by what it gains over them.
    """
    found = roughness(h, form)
    nats = found.nats - max(log_sum(h.shape_log), 0.0)
    if nats < _LEAST_FORM_NATS or found.residual is None:
        return None
    relative = 99.0
    if h.effect_energy is not None:
        relative = relative_size(h.data, h.covariance, h.residual - found.residual, h.effect_energy)
    total = {slow: plain.total[slow] + nats for slow in SLOW}
    return replace(plain, form=form, nats=nats, relative=relative, total=total)


def _late_forces(h: Hypothesis, residual: FloatArray, lags: PullingLags) -> tuple[SlowOnset, SlowOnset]:
    """A gust and a road that set in during the drive."""
    whole = slow_forces(h.data, residual, _from_the_start(h), lags=lags, sensors=sensors_by_frame(h))
    return slow_onset(h.data, residual, whole, "gust"), slow_onset(h.data, residual, whole, "road")


def _set_in(c: Composition, late: tuple[SlowOnset, SlowOnset], beside: tuple[SlowOnset, SlowOnset]) -> Composition:
    """The composition with a gust and a road that set in during the drive, where that gains more than a time is worth:
    as much as `beside` its form, and no more than `late` ones gain without it, which a form may only have bent."""
    gust, road = (own._replace(nats=min(own.nats, alone.nats)) for own, alone in zip(beside, late, strict=True))
    total, slow = dict(c.total), c.slow
    if gust.time is not None:
        total["gust"] += gust.nats
        slow = replace(slow, gust_sd=gust.sd, gust_time=gust.scale)
    if road.time is not None:
        total["road_grade"] += road.nats
        slow = replace(slow, road_sd=road.sd, road_length=road.scale)
    return replace(c, total=total, slow=slow, gust_onset=gust.time, road_onset=road.time)


def _named_as_well(h: Hypothesis, named: list[Hypothesis]) -> bool:
    """Whether one of the sets without a force map explains as much as the force map of `h`, by the names that `h` has
    and others that are curves of the map."""
    if h.force is None:
        return False
    own, curves = set(h.names), {*h.names, *h.force.takes_up}
    return any(own < set(y.names) and set(y.names) <= curves and y.evidence >= h.evidence for y in named)


def _weights(x: Examined, examined: list[Examined]) -> Iterator[Weight]:
    """A weight for every label that the evidence of a set supports: its names with each slow force, with and without
    outliers, some of them as errors of the others' shape, and `unknown` (None as names) where a free form is there."""
    h = x.hypothesis
    named = [e for e in h.effects if not e.startswith("~")]
    names, count = sorted({base_name(e) for e in named}), len(named)
    each = EFFECT_NATS_ALONE if h.alone else EFFECT_NATS
    odds = -each * count - (UNKNOWN_NATS if h.force is not None else 0.0)
    # outliers that another set explains are none, and no set may gain by making more of them
    spikes = [y.outliers.nats for y in examined if y.outliers is not None]
    spike = min(spikes) if spikes else -np.inf
    for c in x.compositions:
        labels: list[tuple[list[str] | None, float]] = [(names, 0.0)]
        for effect, (size, gain) in x.beside.items():
            if effect in names:  # the error of the others' shape
                others = [e for e in h.effects if base_name(e) != effect]
                worth = shape_log_odds(size, gain, others) + each
                labels.append(([n for n in names if n != effect], worth))
        if x.mirror:
            labels += _echoes(x, names)
        if c.form:
            # beside names it is a part without one; alone it is the cause
            labels = [(names or None, -UNKNOWN_NATS)] + [
                (label, worth + shape_log_odds(c.relative, c.nats, h.effects)) for label, worth in labels
            ]
            if c.form == "delay" and "command_hold" in names:
                # losses that are too short to be found one by one delay each frame by their mean: no other cause
                labels[0] = (names, 0.0)
            elif names and h.force is None and c.nats > 0 and c.form not in SIGNS:
                # or one cause without a name does it all, and the names are but terms of its description; but no name
                # describes what chance does
                labels.append((None, -UNKNOWN_NATS + (each - TRIED_NATS) * count))
        total, kinds = dict(c.total), [slow for slow in SLOW if slow in c.total]
        if h.alone:  # some slow force is any drive's
            large = c.slow.gust_sd > _LARGE_OF_COMMAND * h["K_L"] * float(np.std(h.data.command))
            kinds = ["gust"] if large and total["gust"] > total["none"] + SLOW_FORCE_NATS else ["none"]
            total["none"] = max(total["none"], total["gust"] - SLOW_FORCE_NATS)
        for slow, (number, (label, worth)) in itertools.product(kinds, enumerate(labels)):
            part = c.form if number == 0 or label is None else ""
            value = odds + worth
            if slow != "none":
                sd = c.slow.gust_sd if slow == "gust" else c.slow.road_sd
                value -= SLOW_FORCE_NATS + (_FAINT_GUST / sd) ** 2
            causes = None
            if label is not None:
                faint = slow == "gust" and c.slow.gust_sd < _FAINT_GUST
                causes = label + ([] if slow == "none" or faint else [slow])
            for outliers in (False, True) if np.isfinite(spike) else (False,):
                more = spike - OUTLIER_NATS if outliers else 0.0
                text = "unknown"
                if causes is not None and (causes or outliers or h.force is None):
                    text = "+".join(sorted([*causes, *(["outliers"] if outliers else [])])) or "none"
                evidence = total[slow] + (spike if outliers else 0.0)
                yield Weight(text, total[slow] + value + more, evidence, x, c, slow, outliers, part)


def _echoes(x: Examined, names: list[str]) -> list[tuple[list[str] | None, float]]:
    """Labels without linear dynamics whose gain, one by one or of all together, is within that of the mirrored bank:
    theirs, or a loop's echo."""
    h = x.hypothesis
    base = h.base or h
    linear = sorted(_LINEAR & set(names))
    gains: dict[tuple[str, ...], float] = {(e,): x.beside[e][1] for e in linear if e in x.beside}
    if linear and len(linear) == len(h.effects):
        gains[tuple(linear)] = h.evidence - base.evidence
    return [
        ([n for n in names if n not in some], len(some) * EFFECT_NATS - max(gain, 0.0) ** 2 / x.mirror)
        for some, gain in gains.items()
        if gain < x.mirror
    ]
