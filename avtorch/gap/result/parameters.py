"""Parameters of a hypothesis under the answer's names, with uncertainty, and the repaired simulator.

A user's random effect is found as the gust or the outliers that it is like, and called by its own name.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.gap.effects.gust import Gust
from avtorch.gap.effects.outliers import Outliers
from avtorch.gap.effects.road_grade import RoadGrade
from avtorch.gap.engine.average import ModelAverage, Weight
from avtorch.gap.engine.coordinates import EFFECTS, Coordinate, base_name
from avtorch.gap.engine.hypothesis import Hypothesis, effect_values, plant_of
from avtorch.gap.engine.likelihood import whiten
from avtorch.gap.engine.sample import Draws, sample
from avtorch.gap.quantity import Quantity
from avtorch.gap.simulator.effect import EFFECTS as TABLE
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.plant import GapPlant, plant
from avtorch.io.units import GRAVITY

_DRAWS = 1000
_BELIEVED = 64  # of these, handed back with a simulator
_FARTHEST = 12.0  # m/s² or m/s³: no car's limit
_GRID_STEP = 0.07  # standard deviation of the logarithm of what is read from a grid of sizes

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
        if not kind.random or (kind.name in _OF_TABLE and TABLE.get(kind.name) is kind):
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
            new = _with_name(label, each)
            moves = 0.0 if new == label else 0.5 if keeps else 1.0
            for to, share in ((new, moves), (label, 1.0 - moves)):
                if share > 0:
                    chances[to] = chances.get(to, 0.0) + share * p
        for label, w in average.best.items():
            new = _with_name(label, each)
            if new != label:
                best[new] = replace(w, label=new)
            if new == label or keeps:
                best[label] = w
        ordered = dict(sorted(chances.items(), key=lambda kv: -kv[1]))
        average = replace(average, probabilities=ordered, best=best)
    return average


def _with_name(label: str, own: OwnRandom) -> str:
    return "+".join(sorted(own.kind.name if n == own.like else n for n in label.split("+")))


class ParameterPosterior:
    """Draws of what a weight of the model average says: the car's coordinates, and sizes of its random causes.

    `draws` of its hypothesis's coordinates; by Laplace's approximation where None.
    """

    def __init__(
        self, weight: Weight, draws: Draws | None = None, seed: int = 0, own: Sequence[OwnRandom] = ()
    ) -> None:
        self._own = own
        self.weight, self.hypothesis = weight, weight.examined.hypothesis
        self.names = () if weight.label in ("none", "unknown") else tuple(weight.label.split("+"))
        self._given = draws
        self._seed = seed

    @cached_property
    def draws(self) -> Draws:
        if self._given is not None:
            return self._given
        return sample(self.hypothesis, chains=1, draws=_DRAWS, seed=self._seed, method="laplace")

    def _column(self, name: str) -> FloatArray:
        return self.draws[name].reshape(-1)

    @property
    def chains(self) -> dict[str, FloatArray] | None:
        """Draws (chain, draw) by the names of `named`, `T_L` and `K_L` first; None where they are Laplace's alone."""
        if self._given is None:
            return None
        shape = self._given.x.shape[:2]
        out = {name: self._given[name] for name in ("T_L", "K_L")}
        for e in self.effects:
            for key, x in self._reported(e).items():
                name = f"{base_name(e)}.{key}" if len(self.names) > 1 else key
                out[name] = x.expand(shape[0] * shape[1]).numpy().reshape(shape)
        return out

    @property
    def effects(self) -> tuple[str, ...]:
        """Those of the hypothesis that the label names, as the search knows them."""
        return tuple(e for e in self.hypothesis.effects if base_name(e) in self.names)

    def moved(self) -> dict[str, Quantity]:
        """`T_L` [s] and `K_L` [-] under this hypothesis."""
        return {name: Quantity.of_draws(self._column(name)) for name in ("T_L", "K_L")}

    def by_effect(self) -> dict[str, dict[str, Quantity]]:
        """Parameters of each named cause, by the table's names."""
        of_car = {e: {key: Quantity.of_draws(x) for key, x in self._reported(e).items()} for e in self.effects}
        return {base_name(e): own for e, own in of_car.items()} | self._random()

    def named(self) -> dict[str, Quantity]:
        """The same in one mapping: of one cause by its parameters' names, of several as `effect.parameter`."""
        each = self.by_effect()
        if len(self.names) == 1:
            return each.get(self.names[0], {})
        return {f"{name}.{key}": q for name, own in each.items() for key, q in own.items()}

    def belief(self) -> dict[str, FloatArray]:
        """Draws (draw,) of the repaired simulator's parameters, by its own names."""
        every = max(1, len(self._column("T_L")) // _BELIEVED)
        out = {name: self._column(name)[::every][:_BELIEVED] for name in ("T_L", "K_L")}
        for e in self.effects:
            effect = self._drawn(e)
            for p in effect.parameters:
                value = getattr(effect, p.name, None)
                if isinstance(value, torch.Tensor) and value.dim() == 1:
                    out[f"{effect.name}.{p.name}"] = value.numpy()[::every][:_BELIEVED]
        return out

    def plant(self, baseline: GapPlant | None) -> GapPlant:
        """The repaired simulator at the mode, with its random causes. Effects act from the start of a drive, even where
        the car has them from an onset, but for a change of the gain."""
        named = self.hypothesis.copy()
        named.effects = list(self.effects)
        return plant(self._random_effects(), baseline=plant_of(named, baseline), sigma=self.weight.process_noise)

    # inside --------------------------------------------------------------------------------------------------------
    def _drawn(self, e: str) -> Effect:
        """The effect with draws (draw,) as its fields."""
        kind = EFFECTS[e].kind or TABLE[base_name(e)]
        given = effect_values(self.hypothesis, e)
        for c in EFFECTS[e].coordinates:
            given[c.parameter] = torch.as_tensor([_within_reach(c, x) for x in self._column(c.name).tolist()])
        if e == "command_hold":
            rows = len(self.hypothesis.data.time)
            p, n = given["hold_fraction"], len(self.hypothesis.lost)
            relative = 1 / math.sqrt(max(n, 1))  # stretches come one by one
            draws = np.random.default_rng(self._seed).normal(0, relative, len(self._column("T_L")))
            given["hold_fraction"] = torch.as_tensor(np.clip(p * np.exp(draws), 1 / rows, 0.999))
        return kind(**{f.name: given[f.name] for f in fields(kind) if f.name in given})

    def _reported(self, e: str) -> Mapping[str, torch.Tensor]:
        return self._drawn(e).report(torch.as_tensor(self._column("T_L").copy()))

    def _random(self) -> dict[str, dict[str, Quantity]]:
        """Sizes of the random causes that the label names."""
        slow, data = self.weight.composition.slow, self.hypothesis.data
        seconds = len(data.time) * data.dt
        out: dict[str, dict[str, Quantity]] = {}
        likes = {each.like for each in self._own if each.kind.name in self.names}
        if "gust" in self.names or "gust" in likes:
            spread = math.hypot(math.sqrt(slow.gust_time / seconds), _GRID_STEP)
            out["gust"] = {
                "sd_mps2": _log_normal(slow.gust_sd, spread),
                "time_constant_s": _log_normal(slow.gust_time, math.hypot(2 * spread, 2 * _GRID_STEP)),
            }
        if "road_grade" in self.names:
            way = max(float(data.position[-1] - data.position[0]), 1.0)
            spread = math.hypot(math.sqrt(slow.road_length / way), _GRID_STEP)
            out["road_grade"] = {"grade_rms": _log_normal(slow.road_sd / GRAVITY, spread)}
        found = self.weight.examined.outliers
        if ("outliers" in self.names or "outliers" in likes) and found is not None:
            count, rows = max(len(found.starts), 1), len(data.time)
            errors = found.errors[found.starts] if len(found.starts) else np.ones(1)
            scale = float(np.sqrt((errors**2).mean())) / max(self._noise_sd(), 1e-9)
            out["outliers"] = {
                "fraction": _log_normal(count / rows, 1 / math.sqrt(count)),
                "scale": _log_normal(scale, 1 / math.sqrt(2 * count)),
            }
        for each in self._own:
            if each.kind.name in self.names and each.like in out:
                out[each.kind.name] = {own: out[each.like][key] for key, own in each.parameters.items()}
        return {name: x for name, x in out.items() if name in self.names}

    def _noise_sd(self) -> float:
        """Standard deviation [m/s²] of the accelerometer's noise beside outliers; 0 where none were looked for."""
        found = self.weight.examined.outliers
        return 0.0 if found is None else 1.4826 * float(np.median(np.abs(np.diff(found.errors)))) / math.sqrt(2)

    def _random_effects(self) -> list[Effect]:
        sizes = {name: {key: q.mean for key, q in own.items()} for name, own in self._random().items()}
        kinds: dict[str, type[Effect]] = {"gust": Gust, "outliers": Outliers}
        kinds |= {each.kind.name: each.kind for each in self._own}
        noise = self._noise_sd()
        out: list[Effect] = []
        for name, own in sizes.items():
            if name == "road_grade":
                out.append(road_along(self.hypothesis, RoadGrade(own["grade_rms"])))
            else:
                out.append(kinds[name](**own).in_noise(noise))
        return out


def _within_reach(c: Coordinate, z: float) -> float:
    """The parameter at coordinate `z`; a limit that no command of the drive comes near is told as far out as may be."""
    value = c.value(z)
    return value if math.isfinite(value) else math.copysign(_FARTHEST, value)


def road_along(h: Hypothesis, road: RoadGrade) -> RoadGrade:
    """The road with its likeliest profile: the slow force of the residual along the position, a linear regression on
    the road's own splines under the noise of the hypothesis (a Gaussian process; Rasmussen and Williams 2006, 2.7)."""
    data = h.data
    position = torch.as_tensor(data.position - data.position[0])
    prepared = road.prepared(torch.as_tensor(data.time), torch.as_tensor(data.smooth_speed), position)
    size = float(torch.as_tensor(road.grade_rms))
    columns = prepared.columns(position).numpy() * size
    # an accelerometer does not feel a slope
    shows = np.array([name == "speed" or data.accel_kind == "kinematic" for name in data.channels], float)
    forces = [np.multiply.outer(shows, data.transform([c])[0]) for c in columns.T]
    white = np.array([whiten(data, h.covariance, force) for force in forces])
    A = white @ white.T + np.eye(len(white))
    profile = np.linalg.solve(A, white @ whiten(data, h.covariance, h.residual))
    return replace(prepared, profile=torch.as_tensor(profile))


def _log_normal(value: float, spread: float) -> Quantity:
    return Quantity.of_logarithm(math.log(max(value, 1e-9)), spread * spread, 1.6449)


def base_quantities(base: Hypothesis, seed: int = 0) -> tuple[dict[str, Quantity], Mapping[str, FloatArray]]:
    """`T_L` [s] and `K_L` [-] of the base, as quantities and as draws (draw,)."""
    found = sample(base, chains=1, draws=_DRAWS, seed=seed, method="laplace")
    draws = {name: found[name].reshape(-1) for name in ("T_L", "K_L")}
    return {name: Quantity.of_draws(x) for name, x in draws.items()}, {k: x[::15] for k, x in draws.items()}
