"""Which effects the channels of a log, its acceleration and its speed, can speak of."""

from __future__ import annotations

from collections.abc import Collection

from avtorch.gap.simulator.effect import Effect


def is_observable(effect: type[Effect], channels: Collection[str]) -> bool:
    """Whether a log with these channels can speak for or against an effect."""
    if "accel" not in channels:
        return effect.place != "sensor"
    return "speed" in channels or not (effect.needs_speed or effect.alias == "K_L")
