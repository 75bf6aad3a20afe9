"""GLVD with a dead time on both sides, and on one side a change: lag, gain or delay of its own, or one effect more.

An effect that the car has on both sides alike is no change: what it does is left to the remainder, which both sides
share (`shared_remainder`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.gap.budget.effect_model import LATENESS, EffectModel
from avtorch.gap.change.two_sides import TwoSides
from avtorch.gap.simulator.effect import Effect, delay_effect, delay_key
from avtorch.gap.simulator.integrated import Integrated
from avtorch.gap.simulator.plant import GapPlant

AFTER = "after."
"""Begins the name of a coordinate that the side after has of its own."""
_LAGS = (-2.0, -1.0, 0.0, 1.0)  # prior standard deviations, to begin with
_DELAYS_S = (0.03, 0.15)
_TRADED_S = (-0.12, -0.05, -0.02, 0.02, 0.05, 0.12)


@dataclass(frozen=True)
class Change:
    """One thing that differs: the car's own `parameter`, or an effect `kind` on the drives after (`less`: before)."""

    name: str
    parameter: str | None = None
    kind: type[Effect] | None = None
    less: bool = False


def changes(kinds: Sequence[type[Effect]], base: GapPlant, sides: TwoSides) -> list[Change]:
    """What can be tried: T_L, K_L, the dead time, and every effect that shows in these channels.

    An effect whose size has one sign may have appeared or vanished; a bias, which has either, appears.
    """
    delay = delay_effect()
    out = [Change("T_L", "T_L"), Change("K_L", "K_L"), Change(delay.name, delay_key())]
    present = {delay.name, *(e.name for e in base.effects)}
    for kind in kinds:
        hidden = kind.needs_speed and not sides.whole.has_speed
        hidden = hidden or (kind.place == "sensor" and len(sides.whole.channels) < 2)
        if hidden or kind.random or kind.of_the_drive or issubclass(kind, Integrated) or kind.name in present:
            continue
        out.append(Change(kind.name, kind=kind))
        if any(p.constraint != "real" and p.neutral in (0.0, np.inf, -np.inf) for p in kind.parameters):
            out.append(Change(kind.name, kind=kind, less=True))
    return out


@dataclass(frozen=True, eq=False)
class ChangeModel:
    """Both sides as a function of one vector `p`: the coordinates they share, then those of each change."""

    sides: TwoSides
    base: GapPlant
    changes: tuple[Change, ...] = ()
    before: EffectModel = field(init=False)
    after: EffectModel = field(init=False)
    index: Mapping[str, slice] = field(init=False)
    low: FloatArray = field(init=False)
    high: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        models = [self._side(record, less) for record, less in ((self.sides.before, True), (self.sides.after, False))]
        index: dict[str, slice] = {}
        low: list[float] = []
        high: list[float] = []

        def add(name: str, key: str, model: EffectModel) -> None:
            at = model.index[key]
            index[name] = slice(len(low), len(low) + at.stop - at.start)
            low.extend(model.low[at])
            high.extend(model.high[at])

        for key in self._shared(models[0]):
            add(key, key, models[0])
        for change in self.changes:
            if change.parameter is not None:
                add(AFTER + change.parameter, change.parameter, models[1])
            else:
                model = models[0] if change.less else models[1]
                for key in _own(model, change):
                    add(key, key, model)
        for name, value in (
            ("before", models[0]),
            ("after", models[1]),
            ("index", index),
            ("low", np.array(low)),
            ("high", np.array(high)),
        ):
            object.__setattr__(self, name, value)

    def _side(self, record: object, less: bool) -> EffectModel:
        kinds = tuple(c.kind for c in self.changes if c.kind is not None and c.less == less)
        return EffectModel(record, self.base, (delay_effect(), *kinds))  # type: ignore[arg-type]

    @staticmethod
    def _shared(model: EffectModel) -> list[str]:
        return [key for key in model.index if key in ("T_L", "K_L", delay_key(), LATENESS)]

    @property
    def size(self) -> int:
        return len(self.low)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.changes)

    def with_change(self, change: Change) -> ChangeModel:
        return replace(self, changes=(*self.changes, change))

    def without(self, change: Change) -> ChangeModel:
        return replace(self, changes=tuple(c for c in self.changes if c != change))

    # coordinates ---------------------------------------------------------------------------------------------------
    def named(self, p: FloatArray) -> dict[str, FloatArray]:
        return {key: p[at] for key, at in self.index.items()}

    def coordinates(self, known: Mapping[str, FloatArray]) -> FloatArray:
        """A vector (size,) with the coordinates `known` by name; a side's own parameter begins at the shared one."""
        p = np.zeros(self.size)
        for key, at in self.index.items():
            value = known.get(key, known.get(key.removeprefix(AFTER)))
            if value is not None:
                p[at] = value
        return np.clip(p, self.low, self.high)

    def of_side(self, p: FloatArray, *, after: bool, model: EffectModel | None = None) -> FloatArray:
        """Coordinates (..., size) of a side's own model, or of another `model` with that side's values."""
        model = (self.after if after else self.before) if model is None else model
        z = np.zeros((*p.shape[:-1], model.size))
        for key, at in model.index.items():
            own = self.index.get(AFTER + key) if after else None
            own = self.index.get(key) if own is None else own
            if own is not None:
                z[..., at] = p[..., own]
        return z

    def starts(self, known: Mapping[str, FloatArray]) -> FloatArray:
        """First vectors (start, size), from what is `known`: the last change with first values of its own."""
        begun = self.coordinates(known)
        if not self.changes:
            grid = [{"T_L": np.array([lag]), delay_key(): self._delay(s)} for lag in _LAGS for s in _DELAYS_S]
            return np.array([self.coordinates({**known, **point}) for point in grid])
        change = self.changes[-1]
        if change.parameter is not None:
            at = self.index[AFTER + change.parameter]
            out = [begun]
            for moved in (-1.0, -0.4, 0.4, 1.0):
                out.append(begun.copy())
                out[-1][at] += moved
            if change.parameter == delay_key():
                for seconds in (0.05, 0.15, 0.3):
                    out.append(begun.copy())
                    out[-1][at] = self._delay(seconds)
            return np.clip(np.array(out), self.low, self.high)
        assert change.kind is not None
        model = self.before if change.less else self.after
        return _first(self, begun, change, model)

    def _delay(self, seconds: float) -> FloatArray:
        parameter = self.before.plant.parameters()[delay_key()]
        return parameter.unconstrain(torch.tensor([seconds], dtype=torch.float64)).numpy()

    def traded(self, p: FloatArray) -> FloatArray:
        """Places (place, size) where lag and delay of both sides, or of the side after, have traded some time."""
        out: list[FloatArray] = []
        for prefix in ("", AFTER):
            pair = [prefix + key if prefix + key in self.index else key for key in (delay_key(), "T_L")]
            if prefix and not any(key.startswith(AFTER) for key in pair):
                continue
            for seconds in _TRADED_S:
                place = p.copy()
                for key, moved in zip(pair, (seconds, -seconds), strict=True):
                    if prefix and not key.startswith(AFTER):
                        continue
                    parameter = self.before.plant.parameters()[key.removeprefix(AFTER)]
                    value = parameter.constrain(torch.as_tensor(p[self.index[key]])) + moved
                    place[self.index[key]] = parameter.unconstrain(value.clamp_min(0.01)).numpy()
                out.append(np.clip(place, self.low, self.high))
        return np.array(out)

    def at_limit(self, p: FloatArray, change: Change) -> bool:
        """Whether an effect that changed rests where physics ends."""
        if change.kind is None:
            return False
        model = self.before if change.less else self.after
        return model.at_limit(self.of_side(p, after=not change.less), change.name)

    # response ------------------------------------------------------------------------------------------------------
    def simulate(self, p: FloatArray) -> FloatArray:
        """Noise-free channels (..., channel, row) [m/s²] of both sides at `p` (..., size)."""
        each = [
            model.simulate(self.of_side(p, after=after)) for model, after in ((self.before, False), (self.after, True))
        ]
        shape = (*p.shape[:-1], len(self.sides.whole.channels))
        return np.concatenate([np.broadcast_to(x, (*shape, x.shape[-1])) for x in each], -1)

    def difference(self, p: FloatArray) -> FloatArray:
        """(channel, row): what the car after the change would do more than the one before, on the drives of both."""
        out = []
        for record in (self.sides.before, self.sides.after):
            one, other = (replace(model, record=record) for model in (self.before, self.after))
            old = one.simulate(self.of_side(p, after=False, model=one))
            out.append(other.simulate(self.of_side(p, after=True, model=other)) - old)
        return np.concatenate(out, -1)


def _own(model: EffectModel, change: Change) -> list[str]:
    return [key for key in model.index if key.startswith(f"{change.name}.")]


def _first(whole: ChangeModel, begun: FloatArray, change: Change, model: EffectModel) -> FloatArray:
    """The effect's own first values (start, size), the rest as it was."""
    assert change.kind is not None
    time, parameters = model.record.time, model.plant.parameters()
    out = [begun]
    for name, values in change.kind.starts_in(float(time.min()), float(time.max())).items():
        key = f"{change.name}.{name}"
        if key not in whole.index:
            continue
        grown = []
        for place in out:
            for value in values:
                grown.append(place.copy())
                grown[-1][whole.index[key]] = float(
                    parameters[key].unconstrain(torch.tensor(value, dtype=torch.float64))
                )
        out = grown
    starts = np.clip(np.array(out), whole.low, whole.high)
    if len(starts) > _MOST_STARTS:
        starts = starts[np.linspace(0, len(starts) - 1, _MOST_STARTS).astype(int)]
    return starts


_MOST_STARTS = 24
