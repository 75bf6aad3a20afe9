"""What changed between two sets of drives, as an answer says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from avtorch.gap.answer.diagnosis import LogFacts
from avtorch.gap.answer.quantity import Quantity

Telling = Literal["closer", "farther", "no telling"]


@dataclass(frozen=True)
class Moved:
    """One number before and after, and after over before, each with its central 90 %."""

    before: Quantity
    after: Quantity
    ratio: Quantity

    def to_dict(self) -> dict[str, Any]:
        return {"before": self.before.to_dict(), "after": self.after.to_dict(), "ratio": self.ratio.to_dict()}


@dataclass(frozen=True)
class Comparison:
    """`car`: `T_L` [s] and `K_L` as each set of drives has them; `gap`: rollout errors of the simulator, by metric.

    `changed`: the car's are not the same, at `p_value`, the chance of a difference as large between drives of one car.
    `simulator`: whether the drives after are closer to the simulator of that side than those before were.
    """

    before: LogFacts
    after: LogFacts
    car: Mapping[str, Moved]
    gap: Mapping[str, Moved]
    p_value: float
    changed: bool
    simulator: Telling
    why: str

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json`, schema `avtorch.comparison/1`."""
        return {
            "schema": "avtorch.comparison/1",
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "car": {name: moved.to_dict() for name, moved in self.car.items()},
            "gap": {name: moved.to_dict() for name, moved in self.gap.items()},
            "p_value": self.p_value,
            "changed": self.changed,
            "simulator": self.simulator,
            "why": self.why,
        }
