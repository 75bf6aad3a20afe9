"""A user's random effect: found as the gust or the outliers that it is like, and called by its own name."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from avtorch.errors import InputError
from avtorch.gap.engine.average import ModelAverage, Weight
from avtorch.gap.simulator.effect import EFFECTS, Effect

_MADE_OF = {
    "gust": {"force_sd": "sd_mps2", "force_time": "time_constant_s"},
    "outliers": {"tail_fraction": "fraction", "tail_scale": "scale"},
}
"""Parameters of the table's random effects by what they are in `NoiseChange`, the size first."""
_OF_TABLE = ("gust", "outliers", "command_hold", "road_grade")


@dataclass(frozen=True)
class OwnRandom:
    """The class `kind` stands in the place of `like`, "gust" or "outliers"; `parameters` maps that one's names to
    its."""

    kind: type[Effect]
    like: str
    parameters: Mapping[str, str]


def own_random(kinds: Sequence[type[Effect]]) -> list[OwnRandom]:
    """Those of `kinds` that are random and not the table's.

    Raises `InputError` for one that changes neither the force nor the tails of the noise.
    """
    out = []
    for kind in kinds:
        if not kind.random or (kind.name in _OF_TABLE and EFFECTS.get(kind.name) is kind):
            continue
        typical = kind(**{p.name: float(p.typical()) for p in kind.parameters})
        change = typical.noise(torch.zeros(8, dtype=torch.float64))
        like = next((k for k, v in _MADE_OF.items() if change and getattr(change, next(iter(v))) is not None), None)
        if like is None:
            raise InputError(
                f"{kind.name}: found a random effect whose noise is neither a force nor tails, needs one of the two"
            )
        values = {p.name: float(torch.as_tensor(getattr(typical, p.name))) for p in kind.parameters}
        names = {}
        for field, own in _MADE_OF[like].items():
            given = getattr(change, field)
            same = [n for n, x in values.items() if given is not None and abs(x - float(given)) <= 1e-9 * abs(x)]
            if same:
                names[own] = same[0]
        out.append(OwnRandom(kind, like, names))
    return out


def renamed(average: ModelAverage, own: Sequence[OwnRandom], names: Collection[str]) -> ModelAverage:
    """The average in which what each stands for has its name, too, or its name alone where `names` lack the other."""
    for each in own:
        keeps = each.like in names
        chances: dict[str, float] = {}
        best: dict[str, Weight] = {}
        for label, p in average.probabilities.items():
            parts = label.split("+")
            if each.like not in parts:
                chances[label] = chances.get(label, 0.0) + p
                continue
            new = "+".join(sorted(each.kind.name if n == each.like else n for n in parts))
            chances[new] = chances.get(new, 0.0) + (0.5 * p if keeps else p)
            if keeps:
                chances[label] = 0.5 * p
        for label, w in average.best.items():
            parts = label.split("+")
            if each.like in parts:
                new = "+".join(sorted(each.kind.name if n == each.like else n for n in parts))
                best[new] = replace(w, label=new)
            if each.like not in parts or keeps:
                best[label] = w
        ordered = dict(sorted(chances.items(), key=lambda kv: -kv[1]))
        average = replace(average, probabilities=ordered, best=best)
    return average
