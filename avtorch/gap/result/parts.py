"""The parts of an answer: named effects, and the force map of the car and other free forms as parts without a name.

A part is where a cause acts, its family, before it is a name. Its size is what it does to the car's acceleration, so
that sizes of parts compare; shares of the gap are the budget's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.gap.engine.average import ModelAverage, Weight, free_form_response
from avtorch.gap.engine.coordinates import EFFECTS, base_name
from avtorch.gap.engine.family import FORMS, family_of
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.priors import TEMPER
from avtorch.gap.engine.search import Search
from avtorch.gap.quantity import Quantity, of_fields
from avtorch.gap.result.budget import LIKELY, Location
from avtorch.gap.result.hypotheses import LEAST_LISTED, part_probability
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.io.units import GRAVITY

_DRAWS = 400


@dataclass(frozen=True, eq=False)
class AnswerPart:
    """A part of what the simulator lacks: `name` of an effect, None of a free form; its `family`; `form` of a free one.

    `size_mps2`: root mean square of what it adds to the acceleration or to the rate of the speed, None where that is
    not measured. `where` a free form acts, in time, speed, command, frequency.

    """

    name: str | None
    family: str
    form: str | None
    size_mps2: Quantity | None
    probability: float
    where: tuple[Location, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """An entry of `parts` in `diagnosis.json`."""
        return of_fields(self)


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
    weight = _with_map(average, posterior.weight)
    if weight is not None and present >= LEAST_LISTED:
        h = weight.examined.hypothesis
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
    if part.family == "force map" and part.size_mps2 is not None and part.form not in FORMS:
        of = "the speed has" if part.form == "R(v)" else "command and speed have"
        return (
            f"A part without a name is the force map {part.form}: the car's force differs from K u by "
            f"{part.size_mps2.mean:.2g} m/s² as {of} it (probability {probability:.2g})."
        )
    what = "It is most like" if unknown else "A part without a name is of the"
    size = "" if part.size_mps2 is None else f", {part.size_mps2.mean:.2g} m/s² in the root mean square"
    places = ", ".join(place.words(epoch_s) for place in part.where)
    lies = f", {places}" if places else ""
    kind = f"{family}, {FORMS[str(part.form)][1]}" if not unknown else f"{FORMS[str(part.form)][1]} ({family})"
    return f"{what} {kind}{size}{lies} (probability {probability:.2g})."


def map_size(h: Hypothesis, seed: int = 0) -> Quantity:
    """Root mean square [m/s²] over the drive's rows of the force beyond K u, by Laplace's approximation."""
    assert h.force is not None
    n, b = h.force.count, h.force_coefficients
    covariance = np.linalg.inv(h.information)[-n:, -n:] / TEMPER
    sizes, turn = np.linalg.eigh(0.5 * (covariance + covariance.T))
    random = np.random.default_rng(seed).standard_normal((_DRAWS, n))
    draws = b + random * np.sqrt(np.maximum(sizes, 0.0)) @ turn.T
    return Quantity.of_draws(np.sqrt(np.einsum("dk,kl,dl->d", draws, h.force.gram, draws)))


# inside ---------------------------------------------------------------------------------------------------------------
def _with_map(average: ModelAverage, weight: Weight) -> Weight | None:
    """The weight, or else the strongest of the average, that has a force map."""
    having = [w for w in average.best.values() if w.examined.hypothesis.force is not None]
    if weight.examined.hypothesis.force is not None:
        return weight
    return max(having, key=lambda w: w.log_weight, default=None)


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
    return Quantity.of_draws(size * _relative(posterior, effect))


def _relative(posterior: ParameterPosterior, effect: str) -> FloatArray:
    """Draws (draw,) of the size of an effect's first coordinate over that of the fit."""
    h, coordinates = posterior.hypothesis, EFFECTS[effect].coordinates
    if not coordinates:
        return np.ones(1)
    first = coordinates[0]
    neutral = h.without(effect)[first.name]
    at = h[first.name] - neutral
    return np.abs(posterior.draws[first.name].reshape(-1) - neutral) / max(abs(at), 1e-12)
