"""What another tool can hold of a plant, and what it cannot."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from avtorch.gap import Effect, GapPlant


@dataclass(frozen=True)
class Exported:
    """`values` by the tool's own names; `lost`: properties of the plant that the tool cannot express, one sentence
    each.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy import to_autoware
        >>> exported = to_autoware(plant(baseline="sensor_bias=0.1"))
        >>> exported.tool, sorted(exported.values), len(exported.lost)
        ('Autoware planning simulator', ['acc_time_constant', 'acc_time_delay', 'debug_acc_scaling_factor'], 1)
    """

    tool: str
    values: Mapping[str, float]
    lost: tuple[str, ...]

    def to_text(self) -> str:
        """YAML lines, with the lost properties as comments."""
        lines = [f"# {self.tool}", *(f"# not expressed: {text}" for text in self.lost)]
        return "\n".join([*lines, *(f"{name}: {value:.6g}" for name, value in self.values.items())]) + "\n"


def not_exported(plant: GapPlant, reported: Collection[str] = ()) -> tuple[str, ...]:
    """A sentence for each effect of `plant` but those `reported`, which are held or have a sentence already.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy.exported import not_exported
        >>> not_exported(plant(baseline="sensor_bias=0.1, dead_time=0.2"), ["dead_time"])
        ("sensor_bias: the sensor's, not the car's",)
    """
    return tuple(
        f"{e.name}: {SENSOR if e.place == 'sensor' else e.meaning}" for e in plant.effects if e.name not in reported
    )


SENSOR = "the sensor's, not the car's"
OVERSHOOT = "its overshoot; the time constant is that of the two poles together"


def overshoots(effect: Effect) -> bool:
    """Whether it makes the actuator one of second order."""
    return "tau" in effect.actuator_parameters()


def delays_of(plant: GapPlant) -> list[str]:
    """Names of the effects that delay commands and do nothing else.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy.exported import delays_of
        >>> delays_of(plant(baseline="dead_time=0.2, dead_band=0.1"))
        ['dead_time']
    """
    return [e.name for e in plant.effects if e.shift is not None]


def delay_of(plant: GapPlant) -> float:
    """Total delay [s] that all effects add to the command.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy.exported import delay_of
        >>> delay_of(plant(baseline="dead_time=0.2"))
        0.2
    """
    return sum((float(getattr(e, e.shift)) for e in plant.effects if e.shift is not None), 0.0)


def gain_lost(plant: GapPlant, why: str) -> list[str]:
    """A sentence on `K_L`, where it is not 1 to a hundredth.

    Example:
        >>> from avtorch.gap import plant
        >>> from avtorch.remedy.exported import gain_lost
        >>> gain_lost(plant(K_L=0.9), "a gain is learned on the way")
        ['K_L 0.9: a gain is learned on the way']
    """
    gain = float(plant.K_L)
    return [f"K_L {gain:.3g}: {why}"] if abs(gain - 1) > 0.01 else []
