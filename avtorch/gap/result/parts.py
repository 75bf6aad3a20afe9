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
from avtorch.gap.answer.budget import LIKELY
from avtorch.gap.engine.average import ModelAverage, Weight
from avtorch.gap.engine.coordinates import EFFECTS, base_name
from avtorch.gap.engine.force_map import CURVES, ForceMap
from avtorch.gap.engine.hypothesis import Hypothesis
from avtorch.gap.engine.priors import TEMPER
from avtorch.gap.quantity import Quantity
from avtorch.gap.result.hypotheses import LEAST_LISTED, part_probability
from avtorch.gap.result.parameters import ParameterPosterior
from avtorch.io.units import GRAVITY

FAMILIES = {
    "force map": CURVES,
    "dynamics": (
        *("dead_time", "backlash", "second_order_actuator", "rate_limit", "speed_dependent_lag", "gear_shift"),
        "driveline_oscillation",
    ),
    "place": ("road_grade",),
    "time": ("gain_change",),
    "sensor": ("sensor_lag", "sensor_bias", "sensor_scale"),
    "chance": ("gust", "outliers", "command_hold"),
}
"""Where each effect acts."""
FORMS = {
    "linear": ("dynamics", "other linear dynamics"),
    "sided": ("dynamics", "lags that depend on the sign of the command"),
    "tone": ("dynamics", "a steady tone"),
    "map": ("force map", "a force map"),
    "gain": ("time", "a gain that wanders"),
    "delay": ("time", "a delay that wanders"),
}
"""Where each free form acts, and what it is."""
_DRAWS = 400


@dataclass(frozen=True, eq=False)
class AnswerPart:
    """A part of what the simulator lacks: `name` of an effect, None of a free form; its `family`; `form` of a free one.

    `size_mps2`: root mean square of what it adds to the acceleration or to the rate of the speed, None where that is
    not measured. `force_map`: the curve of a force map.

    Example:
        >>> from avtorch.gap.result.parts import AnswerPart
        >>> AnswerPart(None, "force map", "F(u, v)", None, 0.98).to_dict()["name"] is None
        True
    """

    name: str | None
    family: str
    form: str | None
    size_mps2: Quantity | None
    probability: float
    force_map: ForceMap | None = field(default=None, repr=False)

    def to_dict(self) -> dict[str, Any]:
        """An entry of `parts` in `diagnosis.json`."""
        return {
            "name": self.name,
            "family": self.family,
            "form": self.form,
            "size_mps2": None if self.size_mps2 is None else self.size_mps2.to_dict(),
            "probability": self.probability,
        }


def parts_of(
    average: ModelAverage, names: Sequence[str], posterior: ParameterPosterior, seed: int = 0
) -> tuple[AnswerPart, ...]:
    """The named parts of the verdict, in its order, then the force map and the other free forms, the likeliest first;
    `posterior`: of the verdict's weight."""
    parts = [
        AnswerPart(name, _family(name), None, _size(posterior, name), part_probability(average, name))
        for name in names
        if name not in ("none", "unknown")
    ]
    present = min(sum(average.force_maps.values()), 1.0)  # which rounding may exceed
    weight = _with_map(average, posterior.weight)
    if weight is not None and present >= LEAST_LISTED:
        h = weight.examined.hypothesis
        form = max(average.force_maps, key=lambda name: average.force_maps[name])
        parts.append(AnswerPart(None, "force map", form, map_size(h, seed), present, h.force_map))
    for form, probability in sorted(average.parts.items(), key=lambda kv: -kv[1]):
        if probability >= LEAST_LISTED:
            parts.append(AnswerPart(None, FORMS[form][0], form, None, probability))
    return tuple(parts)


def force_map_of(parts: Sequence[AnswerPart]) -> ForceMap | None:
    """The force map of parts in which it is likely."""
    return next((p.force_map for p in parts if p.force_map is not None and p.probability >= LIKELY), None)


def said_of_unnamed(parts: Sequence[AnswerPart]) -> str:
    """A sentence on the likely part without a name, else nothing."""
    part = next((p for p in parts if p.name is None and p.probability >= LIKELY), None)
    if part is None:
        return ""
    if part.size_mps2 is None:
        return f"A part without a name is {FORMS[str(part.form)][1]} (probability {part.probability:.2g})."
    of = "the speed has" if part.form == "R(v)" else "command and speed have"
    return (
        f"A part without a name is the force map {part.form}: the car's force differs from K u by "
        f"{part.size_mps2.mean:.2g} m/s² as {of} it (probability {part.probability:.2g})."
    )


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
def _family(name: str) -> str:
    """The family of an effect; that of a user's own is not known to the table."""
    return next((family for family, names in FAMILIES.items() if name in names), "own")


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
