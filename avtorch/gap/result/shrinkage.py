"""How far a gap shrinks once the effect is added, as an answer says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avtorch.gap.quantity import Quantity


@dataclass(frozen=True)
class Closed:
    """By one measure: `before` the effect is in, `after`, and the `floor` that no model gets below.

    `closed`: (before - after) / (before - floor), None where there is next to nothing to close. Rollout errors are root
    mean squares [m/s², m/s]; densities are mean log densities of a row [nats], of which more is better.

    `horizon_s`: seconds that the rollouts last, None for those of whole drives and for densities.
    """

    before: float
    after: float
    floor: float
    closed: Quantity | None
    horizon_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        closed = None if self.closed is None else self.closed.to_dict()
        told = {"before": self.before, "after": self.after, "floor": self.floor, "closed": closed}
        return told | {"horizon_s": self.horizon_s}


@dataclass(frozen=True)
class Shrinkage:
    """On blocks of the drives that chose neither the effect nor its parameters.

    `metric`: the one of `by_metric` in which the gap shows most. `placebo`: what `placebo_effect`, a wrong effect with
    about as many parameters, closes on top. `ceiling`: after a flexible black box is put on top of the bare baseline,
    by metric. `chosen`: share of the parts in which the other parts alone choose the verdict. `blocks`: how many judge.
    `by_drives`: whole drives were held out.
    """

    metric: str
    by_metric: Mapping[str, Closed]
    placebo_effect: str | None
    placebo: Quantity | None
    ceiling: Mapping[str, float]
    chosen: float
    blocks: int
    by_drives: bool = False

    @property
    def top(self) -> Closed:
        return self.by_metric[self.metric]

    def to_dict(self) -> dict[str, Any]:
        """The object `shrinkage` of `diagnosis.json`."""
        placebo = None if self.placebo is None else self.placebo.to_dict()
        return {
            "metric": self.metric,
            "heldout": True,
            **self.top.to_dict(),
            "by_metric": {name: closed.to_dict() for name, closed in self.by_metric.items()},
            "placebo": {"effect": self.placebo_effect, "closed": placebo},
            "ceiling": dict(self.ceiling),
            "chosen": self.chosen,
            "blocks": self.blocks,
            "heldout_by": "drives" if self.by_drives else "blocks",
        }
