"""Which effects the witnesses of a log, its acceleration and its speed, can speak of."""

from __future__ import annotations

from collections.abc import Collection

from avtorch.gap.chain.effect import Effect


def judged(effect: type[Effect], witnesses: Collection[str]) -> bool:
    """Whether a log with these witnesses can speak for or against an effect."""
    if "accel" not in witnesses:
        return effect.place != "sensor"
    return "speed" in witnesses or not (effect.needs_speed or effect.name == "sensor_scale")
