"""Signals in a tree of structs: which vector is the time, and which others go with it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.io.size import MOST_COLUMNS

TIMES = ("time", "t", "timestamp", "timestamps", "time_s", "t_s", "tout", "seconds", "elapsed", "sec")
"""Names of a time vector in seconds, in the order in which they are tried; capitals do not matter."""
FINER = {"time_ms": 1e-3, "t_ms": 1e-3, "timestamp_ms": 1e-3, "time_us": 1e-6, "timestamp_us": 1e-6}
FINER |= {"t_us": 1e-6, "time_ns": 1e-9, "timestamp_ns": 1e-9, "t_ns": 1e-9}
"""Names that tell another unit, with that unit in seconds."""
_MOST_WIDE = 1000  # columns of a matrix that are channels
_DEEPEST = 16


class Matrix(Protocol):
    """Numbers that may not be read yet."""

    @property
    def shape(self) -> tuple[int, ...]:
        """As MATLAB shows it."""
        ...

    def load(self) -> FloatArray:
        """The numbers, in that shape. Raises an error of the library where they are damaged."""
        ...


@dataclass(frozen=True, eq=False)
class Loaded:
    """Numbers that are read already."""

    values: Any

    @property
    def shape(self) -> tuple[int, ...]:
        return self.values.shape

    def load(self) -> FloatArray:
        return np.array(self.values, dtype=np.float64)


Tree: TypeAlias = "Mapping[str, Matrix | Tree]"


@dataclass(frozen=True)
class Series:
    """One channel: a vector of a matrix, by its index along `axis`, and its time."""

    matrix: Matrix
    axis: int
    index: int
    time: Matrix
    scale: float


@dataclass
class Found:
    """Channels by name, and the paths of those vectors that no time goes with."""

    series: dict[str, Series] = field(default_factory=dict)
    untimed: list[str] = field(default_factory=list)


def find_series(tree: Tree) -> Found:
    """All vectors of the tree that have a time: one of as many samples in their own struct, or in one around it."""
    found = Found()
    _visit(tree, "", None, found, 0)
    return found


def _visit(tree: Tree, path: str, outer: tuple[str, Matrix, float] | None, found: Found, depth: int) -> None:
    if depth > _DEEPEST or len(found.series) >= MOST_COLUMNS:
        return
    clock = _clock(tree) or outer
    own = clock[0] if clock is not None and clock is not outer else None
    values = [name for name in tree if name != own]
    for name in values:
        item = tree[name]
        full = f"{path}.{name}" if path else name
        if isinstance(item, Mapping):
            _visit(item, full, clock, found, depth + 1)
        elif clock is None:
            if _length(item) > 1:
                found.untimed.append(full)
        else:
            # a struct of Time and Data alone is one signal, called as the struct is
            alone = path and own is not None and len(values) == 1 and name.lower() in ("data", "values", "value")
            _add(path if alone else full, item, clock, found)


def _clock(tree: Tree) -> tuple[str, Matrix, float] | None:
    lower = {name.lower(): name for name in reversed(list(tree))}
    for wanted, scale in [*((name, 1.0) for name in TIMES), *FINER.items()]:
        name = lower.get(wanted)
        item = tree[name] if name is not None else None
        if name is not None and item is not None and not isinstance(item, Mapping) and _is_vector(item):
            return name, item, scale
    return None


def _is_vector(item: Matrix) -> bool:
    shape = item.shape
    return _length(item) > 0 and _length(item) == max(shape, default=0)


def _length(item: Matrix) -> int:
    length = 1
    for n in item.shape:
        length *= n
    return length


def _add(name: str, item: Matrix, clock: tuple[str, Matrix, float], found: Found) -> None:
    _, time, scale = clock
    samples, shape = _length(time), item.shape
    if samples < 2 and _length(item) < 2:
        return
    if _is_vector(item) and _length(item) == samples:
        found.series[name] = Series(item, -1, 0, time, scale)
        return
    wide = [n for n in shape if n != 1]
    if len(wide) == 2 and samples in wide:
        axis = 1 if wide[0] == samples else 0  # columns first, where a matrix is square
        for k in range(min(wide[axis], _MOST_WIDE)):
            if len(found.series) >= MOST_COLUMNS:
                return
            found.series[f"{name}({k + 1})"] = Series(item, axis, k, time, scale)
    elif _length(item) > 1:
        found.untimed.append(name)


def vector(series: Series, load: Callable[[Matrix], FloatArray]) -> FloatArray:
    """The samples of a channel, ``(sample,)``, by `load`."""
    whole = load(series.matrix)
    if series.axis < 0:
        return whole.reshape(-1).copy()
    squeezed = whole.reshape([n for n in whole.shape if n != 1])
    return np.array(squeezed.take(series.index, axis=series.axis), dtype=np.float64)
