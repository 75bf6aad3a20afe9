"""Which of two simulators is nearer to a car, and by what."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from avtorch.display import Card, Displayed, Frame
from avtorch.external.surrogate import Surrogate
from avtorch.gap.quantity import Quantity, unit_of, words_of
from avtorch.gap.result.log_facts import LogFacts

Which = Literal["first", "second"]
MATERIAL = 0.01
"""Share of its error by which a simulator has to be better before it is nearer."""
OTHERS = "others"
"""Name of the differences that are told together."""
_CHANNEL = {"rollout_rmse_accel": "acceleration", "rollout_rmse_speed": "speed"}


@dataclass(frozen=True)
class ComparedSimulator:
    """One of the two: `name`; `source`: "plant", "output" or "simulator"; `surrogate`: the chain of effects that
    answers as it does (a plant's is itself); `offset_s`: what its clock was ahead of the log's, by drive; `notes`."""

    name: str
    source: str
    surrogate: Surrogate
    offset_s: tuple[float, ...]
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """As in `comparison.json`."""
        chain = self.surrogate.plant
        effects = {name: _scalars(values) for name, values in chain.report().items()}
        return {
            "name": self.name,
            "source": self.source,
            "offset_s": list(self.offset_s),
            "surrogate": {
                "effects": effects,
                "T_L": float(chain.T_L),
                "K_L": float(chain.K_L),
                "left": dict(self.surrogate.left),
            },
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class ErrorsOfTwo:
    """Rollout errors of both, and the second's relative to the first's, each with its central 90 %."""

    first: Quantity
    second: Quantity
    ratio: Quantity

    def to_dict(self) -> dict[str, Any]:
        """As in `comparison.json`."""
        return {"first": self.first.to_dict(), "second": self.second.to_dict(), "ratio": self.ratio.to_dict()}


@dataclass(frozen=True)
class Difference:
    """What the two have differently: `name` is `T_L`, `K_L` or an effect, its parameters in the `first` and in the
    `second` (None: it has no such effect); or `others`, where several, `parts`, are told together. `ratio`: the factor
    by which it changes the error of the farther one, there as in the nearer one; the mean over all orders in which the
    differences can be put in."""

    name: str
    first: Mapping[str, float] | None
    second: Mapping[str, float] | None
    ratio: Quantity
    parts: tuple[str, ...]

    @property
    def brings_nearer(self) -> bool:
        """Whether the error surely falls, at 95 %."""
        return self.ratio.q95 < 1

    def to_dict(self) -> dict[str, Any]:
        """As in `comparison.json`."""
        sides = {"first": self.first, "second": self.second}
        told = {side: None if values is None else dict(values) for side, values in sides.items()}
        return {"name": self.name, "parts": list(self.parts), **told, "ratio": self.ratio.to_dict()}

    def __str__(self) -> str:
        if self.name == OTHERS:
            return f"{', '.join(self.parts)} together"
        if self.first is None or self.second is None:
            only, own = ("second", self.second) if self.first is None else ("first", self.first)
            return f"{self.name} ({_values(own or {})}), which only the {only} has"
        return f"{self.name} ({_values(self.first)} in the first, {_values(self.second)} in the second)"


@dataclass(frozen=True, repr=False)
class SimulatorComparison(Displayed):
    """`errors` by metric: root mean squares over rollouts of `horizon_s` [s]. `ratio`: the second's error relative to
    the first's, the geometric mean over the metrics. `p_first`, `p_second`: probability that it is nearer, by 1 % of
    its error at least, from the spread between `blocks` blocks of the drives. `differences`: what matters most first.
    """

    log: LogFacts
    first: ComparedSimulator
    second: ComparedSimulator
    errors: Mapping[str, ErrorsOfTwo]
    ratio: Quantity
    p_first: float
    p_second: float
    level: float
    blocks: int
    horizon_s: float
    differences: tuple[Difference, ...]

    def overview(self) -> Card:
        """Which one is nearer, and the errors of both."""
        rows = [
            {"error": metric, "first": e.first.mean, "second": e.second.mean, "ratio": e.ratio.mean}
            for metric, e in self.errors.items()
        ]
        return Card("Comparison of two simulators", (self.why,), Frame.of_rows(rows))

    @property
    def nearer(self) -> Which | None:
        """The nearer one; None where these drives cannot tell them apart at `level`, half of it on either side."""
        sure = 1 - self.level / 2
        return "first" if self.p_first > sure else "second" if self.p_second > sure else None

    @property
    def why(self) -> str:
        """The answer in a sentence or two."""
        errors = ", ".join(
            f"{_CHANNEL[metric]} error {e.first.mean:.3g} and {e.second.mean:.3g}" for metric, e in self.errors.items()
        )
        names = f"first: {self.first.name}, second: {self.second.name}"
        if self.nearer is None:
            r = self.ratio
            return (
                f"These drives cannot tell which simulator is nearer ({names}): the second's error is {r.mean:.2f} "
                f"({r.q05:.2f} to {r.q95:.2f}) of the first's; {errors}.{self._by_channel()}"
            )
        sure = max(self.p_first, self.p_second)
        told = f"at a probability of {sure:.3f}" if sure < 0.9995 else "at a probability above 0.999"
        said = f"The {self.nearer} simulator is nearer to the car, {told} ({names}): {errors}."
        chief = [f"{d}, a factor of {d.ratio.mean:.2f}" for d in self.differences if d.brings_nearer][:2]
        if not chief:
            return f"{said} No single one of their differences surely makes it so."
        return f"{said} What brings it nearer: {'; '.join(chief)} in its error."

    def _by_channel(self) -> str:
        """A sentence where the channels contradict each other."""
        first = [_CHANNEL[m] for m, e in self.errors.items() if e.ratio.q05 > 1]
        second = [_CHANNEL[m] for m, e in self.errors.items() if e.ratio.q95 < 1]
        if not (first and second):
            return ""
        return f" The first is nearer in {' and '.join(first)}, the second in {' and '.join(second)}."

    def to_dict(self) -> dict[str, Any]:
        """The object of `comparison.json` for two simulators, schema `avtorch.simulators/1`."""
        return {
            "schema": "avtorch.simulators/1",
            "log": self.log.to_dict(),
            "first": self.first.to_dict(),
            "second": self.second.to_dict(),
            "errors": {metric: e.to_dict() for metric, e in self.errors.items()},
            "horizon_s": self.horizon_s,
            "blocks": self.blocks,
            "ratio": self.ratio.to_dict(),
            "probability": {"first": self.p_first, "second": self.p_second},
            "level": self.level,
            "nearer": self.nearer,
            "differences": [d.to_dict() for d in self.differences],
            "why": self.why,
        }


def _scalars(values: Mapping[str, Any]) -> dict[str, float]:
    return {key: float(x) for key, x in values.items() if x.dim() == 0}


def _values(values: Mapping[str, float]) -> str:
    told = []
    for key, value in values.items():
        unit = unit_of(key)
        words = "" if key in ("T_L", "K_L") else f"{words_of(key)} "
        told.append(f"{words}{value:.3g}{'' if unit == '-' else f' {unit}'}")
    return ", ".join(told)
