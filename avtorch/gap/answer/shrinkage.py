"""How far the gap shrinks on held-out blocks, by measure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from avtorch.gap.quantity import Quantity


@dataclass(frozen=True)
class MetricShrinkage:
    """Errors by one measure: `before` the effect is added, `after`, and the `floor` that no model can go below.

    `closed`: (before - after) / (before - floor), None where there is almost nothing to close. Rollout errors are root
    mean squares [m/s², m/s]; densities are mean log densities per row [nats], of which higher is better.

    `horizon_s`: length of the rollouts [s], None for those of whole drives and for densities.
    """

    before: float
    after: float
    floor: float
    closed: Quantity | None
    horizon_s: float | None = None

    def to_dict(self) -> dict[str, Any]:
        closed = None if self.closed is None else self.closed.to_dict()
        levels = {"before": self.before, "after": self.after, "floor": self.floor, "closed": closed}
        return levels | {"horizon_s": self.horizon_s}


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks on held-out blocks of the drives.

    `metric`: the one of `by_metric` in which the gap is clearest. `placebo`: what `placebo_effect`, a wrong effect with
    about as many parameters, closes when added. `ceiling`: error after a flexible black box is added to the bare
    baseline, by metric. `chosen`: share of the folds in which the other folds alone select the verdict, None where
    they were not asked. `blocks`: number of held-out blocks. `by_drives`: whole drives were held out.
    """

    metric: str
    by_metric: Mapping[str, MetricShrinkage]
    placebo_effect: str | None
    placebo: Quantity | None
    ceiling: Mapping[str, float]
    chosen: float | None
    blocks: int
    by_drives: bool = False

    @property
    def top(self) -> MetricShrinkage:
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
