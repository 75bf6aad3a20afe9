"""A cause as a person says it, by the sentence that its effect brings; its name stands behind."""

from __future__ import annotations

import math
from collections.abc import Mapping

from avtorch.gap.simulator.effect import EFFECTS


def cause_words(name: str, values: Mapping[str, float]) -> str:
    """What the effect called `name` does to the car, at `values` of its parameters under the answer's names.

    Its general meaning where a value is not known; empty where it brings no sentence or is not registered.

    Example:
        >>> from avtorch.gap.simulator.cause_words import cause_words
        >>> cause_words("brake_throttle_asymmetry", {"brake_gain_ratio": 0.7, "brake_lag_ratio": 1.0})
        'the brake is weaker than the throttle'
        >>> cause_words("dead_time", {}), cause_words("trailer", {"mass_ratio": 0.4})
        ('the command acts after a delay', '')
    """
    kind = EFFECTS.get(name)
    if kind is None or not kind.brings_words():
        return ""
    needed = [p.name for p in (kind.derived or kind.parameters) if p.reported]
    if any(math.isnan(values.get(key, math.nan)) for key in needed):
        return kind.meaning
    return kind.in_words(values)


def named_cause(name: str, values: Mapping[str, float], behind: str = "") -> str:
    """The cause in words, in brackets its name and what is said `behind` it; the name alone where there are no words.

    Example:
        >>> from avtorch.gap.simulator.cause_words import named_cause
        >>> named_cause("dead_time", {"delay_s": 0.21}, "62 % of the gap")
        'commands act 0.21 s late (dead_time, 62 % of the gap)'
        >>> named_cause("trailer", {}, "62 % of the gap"), named_cause("trailer", {})
        ('trailer (62 % of the gap)', 'trailer')
    """
    words = cause_words(name, values)
    inside = ", ".join(x for x in (name if words else "", behind) if x)
    return f"{words or name} ({inside})" if inside else name
