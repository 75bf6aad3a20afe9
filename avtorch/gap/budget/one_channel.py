"""What a log with acceleration alone cannot tell from the parts of a budget.

Effects that need a speed are not tried there, nor is an offset of the sensor, which is a force on the car as far as
that channel goes. Held-out blocks that are sure of a force do not know whose it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from avtorch.gap.answer.budget import Budget, ChancePart, Part
from avtorch.gap.budget.selection_step import Selection
from avtorch.gap.selection.aliases import in_place_of
from avtorch.gap.simulator.effect import Effect
from avtorch.io import Log


def with_untested(budget: Budget, selection: Selection, logs: Sequence[Log], kinds: Sequence[type[Effect]]) -> Budget:
    """The budget of a selection, with those of `kinds` in the alias sets that `logs` without a speed cannot tell from
    a part."""
    if any(log.speed is not None for log in logs):
        return budget
    fit, asked = selection.last.fit, {kind.name for kind in kinds}
    values = {key: float(value) for key, value in fit.model.values(fit.z).items() if value.numel() == 1}
    specific = logs[0].accel_kind == "specific-force"
    names = [part.name for part in (*budget.parts, *budget.chance)]

    def alike(part: Part | ChancePart) -> tuple[str, ...]:
        others = [name for name in names if name != part.name]
        found = in_place_of(part.name, others, ("accel",), values, specific_force=specific, among=kinds)
        return tuple(sorted({*part.alias_set, *(found & asked)}))

    parts = tuple(replace(part, alias_set=alike(part)) for part in budget.parts)
    return replace(budget, parts=parts, chance=tuple(replace(part, alias_set=alike(part)) for part in budget.chance))
