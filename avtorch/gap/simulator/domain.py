"""Valid values of an effect's field given as text: a finite number in its range, or a list of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from avtorch.errors import InputError, printable
from avtorch.gap.simulator.parameter import Parameter

# typical ranges come from experience: no car exceeds them a thousandfold, nor does a fit fall a million times below
_FAR, _NEAR = 1e3, 1e6


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
    kind: str = ""
    whole: bool = False
    least: int = 1
    most: int = 0
    rising: bool = False

    @classmethod
    def of(cls, parameter: Parameter) -> Domain:
        """The domain from a millionth of the typical range of `parameter` to a thousand times that range."""
        low, high, kind = parameter.low, parameter.high, parameter.constraint
        unit = "" if parameter.unit == "-" else parameter.unit
        if kind == "interval":  # its ends depend on a drive, which is not known yet
            return cls(parameter.name, -1e12, 1e12, unit)
        ends = {
            "positive": (low / _NEAR, high * _FAR),
            "negative": (low * _FAR, high / _NEAR),
            "unit": (0.0, 1.0),
            "real": (-_FAR * max(abs(low), abs(high)), _FAR * max(abs(low), abs(high))),
        }[kind]
        signed = kind if kind in ("positive", "negative") else ""
        return cls(parameter.name, *ends, unit, parameter.neutral, signed)

    def value(self, where: str, given: Any) -> Any:
        """`given` as a float, an int or a tuple. Raises an `InputError` that begins with `where`."""
        if not self.most:
            return self._number(where, given)
        if not isinstance(given, list) or not self.least <= len(given) <= self.most:
            what = f"a list of {len(given)} values" if isinstance(given, list) else _found(given)
            raise InputError(f"{where}: found {what}, needs a list of {self.least} to {self.most} numbers")
        values = tuple(self._number(f"{where}[{i}]", x) for i, x in enumerate(given))
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
            noun = f"a {self.kind} number" if self.kind else "a whole number" if self.whole else "a number"
            also = "" if self.neutral is None else f", or {self.neutral:g}"
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(f"{where} is {value:g}, needs {noun} ({self.low:g} to {self.high:g}{unit}){also}")
        return int(value) if self.whole else value


def _found(given: Any) -> str:
    """A value as shown in a message: TOML's own words for booleans, the type for anything that is no single value."""
    if isinstance(given, bool):
        return str(given).lower()
    if isinstance(given, list | dict):
        return "a list" if isinstance(given, list) else "a table"
    return printable(repr(given), 40)
