"""Which effects are observable in the channels of a log, its acceleration and its speed."""

from __future__ import annotations

from collections.abc import Collection

from avtorch.gap.simulator.effect import Effect


def is_observable(effect: type[Effect], channels: Collection[str]) -> bool:
    """Whether an effect can be tested on a log with these channels."""
    if "accel" not in channels:
        return effect.place != "sensor"
    return "speed" in channels or not (effect.needs_speed or effect.alias == "K_L")
