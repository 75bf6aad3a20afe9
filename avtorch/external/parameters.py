"""The numbers that a user's simulator lets one set: its own parameters, by their own names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import fields, is_dataclass, replace
from inspect import getattr_static
from typing import Any, Protocol, runtime_checkable

from avtorch.errors import InputError, listed, quoted
from avtorch.external.simulator import Simulator

Limits = Mapping[str, tuple[float, float]]
"""Lowest and highest value by parameter."""


@runtime_checkable
class Adjustable(Protocol):
    """A simulator that says which parameters it has and makes another with other values; an `FmuSimulator` is one."""

    def parameters(self) -> Mapping[str, float]: ...

    def with_parameters(self, values: Mapping[str, float], /) -> Simulator: ...


def values_of(simulator: Simulator, limits: Limits) -> dict[str, float]:
    """What the simulator has for the parameters in `limits`.

    They are those of an `Adjustable`, fields of a dataclass, or attributes of the object that are numbers. Raises
    `InputError` for a name that is none of these, limits that are no two rising numbers, and a value outside of them.
    """
    if isinstance(simulator, Adjustable):
        known = dict(simulator.parameters())
    else:
        # as they stand there: a property may not be ready before a drive begins
        found: dict[str, Any] = {n: getattr_static(simulator, n) for n in dir(simulator) if not n.startswith("_")}
        known = {n: float(x) for n, x in found.items() if isinstance(x, int | float) and not isinstance(x, bool)}
    for name, (low, high) in limits.items():
        if name not in known:
            raise InputError(
                f"adjustable: found {quoted(name)}, needs one of {listed(known) or 'no name: it has none'}"
            )
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(
                f"adjustable {name}: found limits {low:g} and {high:g}, needs two finite numbers that rise"
            )
        if not low <= known[name] <= high:
            raise InputError(
                f"adjustable {name}: is {known[name]:g}, needs limits that hold it, found {low:g} to {high:g}"
            )
    return {name: known[name] for name in limits}


def with_values(simulator: Simulator, values: Mapping[str, float]) -> Simulator:
    """The simulator with these parameters; the one that is given stays as it is.

    A dataclass is made anew, so that what it derives from its fields follows them; of another object it is a copy
    whose attributes are set.
    """
    if isinstance(simulator, Adjustable):
        return simulator.with_parameters(values)
    settable = {f.name for f in fields(simulator) if f.init} if is_dataclass(simulator) else set[str]()
    if is_dataclass(simulator) and not isinstance(simulator, type) and set(values) <= settable:
        return replace(simulator, **values)
    other = deepcopy(simulator)
    for name, value in values.items():
        setattr(other, name, value)
    return other
