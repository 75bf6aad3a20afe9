"""What has changed between two sets of drives, by how much, or that these drives do not show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import Any, Literal

from avtorch.gap.quantity import Quantity, unit_of, words_of

Answer = Literal["named", "ambiguous", "unknown", "drift", "none"]


@dataclass(frozen=True)
class ChangePart:
    """One thing that has changed: `name` is T_L, K_L or an effect; `parameters` the change itself.

    `alias_set`: what held-out blocks cannot distinguish from it, itself among them. `less`: an effect that the drives
    before have more of.

    Example:
        >>> from avtorch.gap.answer.change import ChangePart
        >>> from avtorch.gap.quantity import Quantity
        >>> part = ChangePart("K_L", ("K_L",), 0.99, {"change": Quantity(-0.1, 0.01, -0.12, -0.08)})
        >>> part.to_dict()["parameters"]["change"]["mean"]
        -0.1
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Quantity]
    less: bool = False

    def to_dict(self) -> dict[str, Any]:
        return {
            "names": [self.name],
            "alias_set": list(self.alias_set),
            "probability": self.probability,
            "parameters": {key: value.to_dict() for key, value in self.parameters.items()},
            "less": self.less,
        }

    def __str__(self) -> str:
        name = f"less {self.name}" if self.less else self.name
        sizes = ", ".join(_text(key, q) for key, q in self.parameters.items() if is_change(key))
        return f"{name} ({sizes})" if sizes else name


@dataclass(frozen=True)
class ChangeCause:
    """What has changed: `parts`, the first found first.

    `answer`: `"named"`; `"ambiguous"` where a part has aliases; `"unknown"` where something reproducible has changed
    that no effect explains; `"drift"` where a change is supported, but halves of one side differ by as much; `"none"`,
    also where a change is supported whose size is too uncertain. `detectable`: the least change of T_L and K_L (as a
    share) and of dead time [s] that these drives show, infinite (in JSON null) where they show none. `why`: one or two
    sentences.

    Example:
        >>> from avtorch.gap.answer.change import ChangeCause
        >>> ChangeCause((), "none", {"K_L": 0.03}, "No change is named.").to_dict()["names"]
        []
    """

    parts: tuple[ChangePart, ...]
    answer: Answer
    detectable: Mapping[str, float]
    why: str

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(part.name for part in self.parts)

    @property
    def probability(self) -> float | None:
        """That other drives of the two cars would name the least certain part again; None without parts."""
        return min((part.probability for part in self.parts), default=None)

    def to_dict(self) -> dict[str, Any]:
        return {
            "answer": self.answer,
            "names": list(self.names),
            "alias_set": list(dict.fromkeys(name for part in self.parts for name in part.alias_set)),
            "probability": self.probability,
            "parameters": {
                f"{part.name}.{key}": value.to_dict() for part in self.parts for key, value in part.parameters.items()
            },
            "parts": [part.to_dict() for part in self.parts],
            "detectable": {name: value if isfinite(value) else None for name, value in self.detectable.items()},
            "why": self.why,
        }


def detectable_text(name: str, value: float) -> str:
    """A least change with its unit: a share of T_L and K_L, seconds of dead time."""
    if not isfinite(value):
        return "none"
    if name not in ("T_L", "K_L"):
        return f"{value:.2g} s"
    return f"{value:.0%}" if value > 0.02 else f"{100 * value:.1g}%"


def is_change(key: str) -> bool:
    """Whether a parameter of a change is its size, not what was before or after it."""
    return not key.startswith(("before", "after"))


def _text(key: str, q: Quantity) -> str:
    unit = unit_of(key)
    word = "" if key.startswith("change") else f"{words_of(key)} "
    return f"{word}{q.mean:+.3g}{'' if unit == '-' else ' ' + unit}, 90 % {q.q05:.3g} to {q.q95:.3g}"
