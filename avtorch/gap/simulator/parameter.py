"""A parameter of an effect: its unit, its typical range, its prior, its unconstrained coordinate for fits, and the
values that a text may give it.

Every prior is a standard normal `z` passed through a link, `value = link(location + spread z)`, so the prior of `z`
needs no Jacobian and every coordinate of a fit has scale one. The typical range holds the prior's central 80 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, cast

import torch
from torch import Tensor

from avtorch.errors import InputError, printable

Constraint = Literal["real", "positive", "negative", "unit"]
_LINKS: dict[Constraint, tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]] = {
    "real": (lambda x: x, lambda x: x),
    "positive": (torch.log, torch.exp),
    "negative": (lambda x: torch.log(-x), lambda x: -torch.exp(x)),
    "unit": (torch.logit, torch.sigmoid),
}
"""From a value to the scale of its prior, and back."""

_CENTRAL_80 = 1.2815515655446004  # normal quantile of 0.9
_AS_FAR = 3.0  # multiple of the typical range, where an effect does not state what is possible

# typical ranges come from experience: no car exceeds them a thousandfold, nor does a fit fall a million times below
_FAR, _NEAR = 1e3, 1e6


@dataclass(frozen=True)
class Parameter:
    """`name` (the key in an answer), `unit`, `neutral` value (None: any, once the others are neutral), typical range.

    `constraint` is the link: `"real"` the value itself, `"positive"` its log, `"negative"` the log of its opposite,
    `"unit"` (0 to 1) its logit. `reported` False: a coordinate that is fitted but not part of the answer. `possible`:
    the physically possible range; an answer entirely outside it is reported as implausible. Default: three times the
    typical range, on the link's scale.

    Raises `InputError` for a range that is empty or outside the constraint.

    Example:
        >>> import torch
        >>> from avtorch.gap import Parameter
        >>> lag = Parameter("lag_s", "s", neutral=0.0, low=0.1, high=0.4)
        >>> round(lag.typical().item(), 2)  # the prior's median, a geometric mean
        0.2
        >>> round(lag.constrain(lag.unconstrain(torch.tensor(0.3, dtype=torch.float64))).item(), 6)
        0.3
    """

    name: str
    unit: str
    neutral: float | None
    low: float
    high: float
    constraint: Constraint = "positive"
    reported: bool = True
    possible: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise InputError(f"{self.name}: found the range {self.low:g} to {self.high:g}, needs low < high")
        if not all(math.isfinite(x) for x in self._ends):
            raise InputError(f"{self.name}: {self.low:g} to {self.high:g} is not within {self.constraint!r}")
        if self.possible is not None and not self.possible[0] < self.possible[1]:
            raise InputError(f"{self.name}: found possible={self.possible!r}, needs low < high")

    @property
    def location(self) -> float:
        """Centre of the prior on the link's scale."""
        return 0.5 * sum(self._ends)

    @property
    def spread(self) -> float:
        """Standard deviation of the prior on the link's scale."""
        low, high = self._ends
        return abs(high - low) / (2 * _CENTRAL_80)

    @property
    def physical(self) -> tuple[float, float]:
        """The physically possible least and greatest value: `possible`, or its default."""
        if self.possible is not None:
            return self.possible
        z = _AS_FAR * _CENTRAL_80 * torch.tensor([-1.0, 1.0], dtype=torch.float64)
        low, high = sorted(float(x) for x in self.constrain(z))
        return low, high

    @cached_property
    def _ends(self) -> tuple[float, float]:
        """`low` and `high` on the link's scale."""
        link = _LINKS[self.constraint][0]
        low, high = (float(link(torch.tensor(x, dtype=torch.float64))) for x in (self.low, self.high))
        return low, high

    def constrain(self, z: Tensor) -> Tensor:
        """The value for `z`, elementwise."""
        return _LINKS[self.constraint][1](self.location + self.spread * z)

    def unconstrain(self, value: Tensor) -> Tensor:
        """`z` for a value, elementwise; infinite for a neutral value at the edge of the constraint."""
        return (_LINKS[self.constraint][0](value) - self.location) / self.spread

    def typical(self) -> Tensor:
        """The prior's median."""
        return self.constrain(torch.zeros((), dtype=torch.float64))

    def sample(self, *shape: int, generator: torch.Generator | None = None) -> Tensor:
        """Draws from the prior, of the given shape."""
        return self.constrain(torch.randn(shape, generator=generator, dtype=torch.float64))


@dataclass(frozen=True)
class Domain:
    """Valid values of field `name`: numbers from `low` to `high`, and `neutral`, at which the effect is zero, in any
    case.

    `whole`: whole numbers only. `most` above 0: a list of `least` to `most` numbers, `rising` or not.

    Example:
        >>> from avtorch.gap import Domain
        >>> share = Domain("depth", low=0.0, high=1.0, neutral=0.0)
        >>> share.value("gear_shift.depth", 0.7)
        0.7
    """

    name: str
    low: float
    high: float
    unit: str = ""
    neutral: float | None = None
    whole: bool = False
    least: int = 1
    most: int = 0
    rising: bool = False

    @classmethod
    def of(cls, parameter: Parameter) -> Domain:
        """The domain from a millionth of the typical range of `parameter` to a thousand times that range."""
        low, high, kind = parameter.low, parameter.high, parameter.constraint
        unit = "" if parameter.unit == "-" else parameter.unit
        ends = {
            "positive": (low / _NEAR, high * _FAR),
            "negative": (low * _FAR, high / _NEAR),
            "unit": (0.0, 1.0),
            "real": (-_FAR * max(abs(low), abs(high)), _FAR * max(abs(low), abs(high))),
        }[kind]
        return cls(parameter.name, *ends, unit, parameter.neutral)

    def value(self, where: str, given: Any) -> Any:
        """`given` as a float, an int or a tuple. Raises an `InputError` that begins with `where`."""
        if not self.most:
            return self._number(where, given)
        each = cast("list[Any] | None", given if isinstance(given, list) else None)
        if each is None or not self.least <= len(each) <= self.most:
            what = _found(given) if each is None else f"a list of {len(each)} values"
            raise InputError(f"{where}: found {what}, needs a list of {self.least} to {self.most} numbers")
        values = tuple(self._number(f"{where}[{i}]", x) for i, x in enumerate(each))
        if self.rising and any(b <= a for a, b in pairwise(values)):
            raise InputError(f"{where}: found {_found(given)}, needs numbers that rise")
        return values

    def _number(self, where: str, given: Any) -> float | int:
        if isinstance(given, bool) or not isinstance(given, int | float):
            raise InputError(f"{where}: found {_found(given)}, needs a number")
        try:
            value = float(given)
        except OverflowError:
            value = math.inf
        if value == self.neutral:
            return value
        if not self.low <= value <= self.high or (self.whole and value != int(value)):
            noun = "a whole number" if self.whole else "a number"
            also = "" if self.neutral is None else f", or {self.neutral:g}"
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(f"{where} is {value:g}, needs {noun} ({self.low:g} to {self.high:g}{unit}){also}")
        return int(value) if self.whole else value


def _found(given: Any) -> str:
    return printable(repr(given), 40)
