"""What comparing two sets of drives finds: what has changed, by how much, or that these drives do not show it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any, Literal

from avtorch.display import Card, Displayed, Frame
from avtorch.gap.quantity import Quantity, of_fields, plain, unit_of, words_of
from avtorch.gap.result.log_facts import LogFacts

if TYPE_CHECKING:
    import pandas

Answer = Literal["named", "ambiguous", "unknown", "drift", "none"]
SimulatorChange = Literal["closer", "farther", "inconclusive"]


@dataclass(frozen=True)
class ChangePart:
    """One thing that has changed: `name` is T_L, K_L or an effect; `parameters` the change itself.

    `alias_set`: what held-out blocks cannot distinguish from it, itself among them. `less`: an effect that the drives
    before have more of.
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    parameters: Mapping[str, Quantity]
    less: bool = False

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        return {"names": [out.pop("name")]} | out

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
        each = {f"{part.name}.{key}": q for part in self.parts for key, q in part.parameters.items()}
        return of_fields(self) | {
            "names": list(self.names),
            "alias_set": list(dict.fromkeys(name for part in self.parts for name in part.alias_set)),
            "probability": self.probability,
            "parameters": plain(each),
            "detectable": {name: value if isfinite(value) else None for name, value in self.detectable.items()},
        }


@dataclass(frozen=True)
class Change:
    """One number before and after, and the ratio of after to before, each with its central 90 %."""

    before: Quantity
    after: Quantity
    ratio: Quantity


@dataclass(frozen=True, repr=False)
class Comparison(Displayed):
    """`car`: `T_L` [s] and `K_L` fitted to each set of drives; `gap`: rollout errors of the simulator, by metric, over
    `horizon_s` [s]: 10 s, or less where the longest stretch of either set is shorter.

    `changed`: the car's parameters differ, with p-value `p_value` for drives of one car. `simulator`: whether the
    simulator's errors on the drives after are smaller than those on the drives before (each with its own simulator,
    where two are given); `"inconclusive"`: neither. `cause`: what of T_L, K_L, dead time and all effects differs; None
    where both sides are one drive, or differ in their rates.
    """

    before: LogFacts
    after: LogFacts
    car: Mapping[str, Change]
    gap: Mapping[str, Change]
    p_value: float
    changed: bool
    simulator: SimulatorChange
    why: str
    cause: ChangeCause | None = None
    horizon_s: float = 10.0

    def overview(self) -> Card:
        """What has changed, in a sentence or two, and what was measured before and after."""
        answer = "the car has changed" if self.changed else "no change of T_L and K_L is detected"
        table = {name: values for name, values in self.summary().columns.items() if name != "sd"}
        return Card(
            f"Comparison of two sets of drives: {answer} (p = {self.p_value:.2g})", (self.why,), Frame(table), 9
        )

    def summary(self) -> Frame:
        """A row a parameter or error and `side`: before, after, and their ratio; mean, sd, 5 and 95 % quantiles."""
        rows: list[dict[str, object]] = []
        for name, moved in (*self.car.items(), *self.gap.items()):
            unit = {"rollout_rmse_accel": "m/s²", "rollout_rmse_speed": "m/s"}.get(name) or unit_of(name)
            for side, q in (("before", moved.before), ("after", moved.after), ("ratio", moved.ratio)):
                rows.append({"parameter": name, "side": side, "unit": "-" if side == "ratio" else unit, **q.to_dict()})
        return Frame.of_rows(rows)

    def to_dataframe(self) -> pandas.DataFrame:
        """`summary` as a data frame. Needs ``pip install 'avtorch[pandas]'``."""
        return self.summary().to_dataframe()

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json`, schema `avtorch.comparison/1`."""
        return {"schema": "avtorch.comparison/1"} | of_fields(self)


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
