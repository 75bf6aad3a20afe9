"""The simulator that is diagnosed, where it is not avtorch's own: what it is, and which of its parameters are wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avtorch.gap.quantity import Quantity, of_fields, unit_behind, words_of
from avtorch.gap.simulator.plant import GapPlant

SAME_KIND = 0.1
"""Least size of an effect in the simulator, relative to the car's, from which it is there and has a wrong size."""


def _short(x: float) -> str:
    """Three digits that say something, without an exponent up to a million."""
    return f"{float(f'{x:.3g}'):g}"


@dataclass(frozen=True)
class ParameterDifference:
    """A parameter `name` (`T_L`, `K_L`, or `effect.parameter`) of the simulator, and of the `car` that was driven.

    `differs`: surely, and by more than matters. `own`: it is one of the simulator's own, by its user's name.
    """

    name: str
    simulator: float
    car: Quantity
    differs: bool
    own: bool = False

    def __str__(self) -> str:
        effect, _, key = ("", "", self.name) if self.own else self.name.rpartition(".")
        unit = "" if self.own else unit_behind(key)
        words = f"{effect}: {words_of(key)}" if effect else key
        shown = _short if effect or self.own else "{:.2f}".format
        own, mean, low, high = map(shown, (self.simulator, self.car.mean, self.car.q05, self.car.q95))
        return f"{words} {own}{unit}, on the car {mean}{unit} ({low} to {high})"


@dataclass(frozen=True)
class SimulatorUnderTest:
    """A simulator that is not avtorch's own.

    `name`; `source`: "output" or "simulator"; `offset_s`: what its clock was ahead of the log's, by drive. `surrogate`:
    the chain of effects that answers as it does, except for the shares `left` of the response, by channel.
    `rollout`: its error against the car over 10 s as it is, by channel [m/s², m/s], before anything is fitted.
    `parameters`: the simulator's own that it was allowed to adjust, and those of the surrogate, beside the car's; where
    one of its own differs, the surrogate is that of the simulator with the car's values. `missing`: effects of the
    verdict that it does not have. `rollouts`: how often the simulator was driven through the drives to fit its own.
    """

    name: str
    source: str
    offset_s: tuple[float, ...]
    surrogate: GapPlant
    left: Mapping[str, float]
    rollout: Mapping[str, float]
    parameters: tuple[ParameterDifference, ...] = ()
    missing: tuple[str, ...] = ()
    rollouts: int = 0

    @property
    def wrong(self) -> tuple[ParameterDifference, ...]:
        """Parameters that differ."""
        return tuple(p for p in self.parameters if p.differs)

    def to_dict(self) -> dict[str, Any]:
        car = self.surrogate
        effects = {
            effect: {key: float(x) for key, x in values.items() if x.dim() == 0}
            for effect, values in car.report().items()
        }
        own = {"effects": effects, "T_L": float(car.T_L), "K_L": float(car.K_L)}
        out = of_fields(self)
        out |= {"surrogate": own | {"left": out.pop("left")}, "rollout_10s": out.pop("rollout")}
        return out
