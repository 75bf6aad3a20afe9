"""MAT files: version 5 by SciPy, version 7.3 by h5py, MATLAB's tables by mat-io; and which vector is the time of which.

A file is a tree of structs. A signal is a vector with a time: one of as many samples in its own struct, or in one
around it.
"""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind, guarded, library, reason
from avtorch.io.formats.listed import Channel, Recording, refuse_cells
from avtorch.io.opening import MOST_COLUMNS, opened, place

TIMES = ("time", "t", "timestamp", "timestamps", "time_s", "t_s", "tout", "seconds", "elapsed", "sec")
"""Names of a time vector in seconds, in the order in which they are tried; capitals do not matter."""
FINER = {"time_ms": 1e-3, "t_ms": 1e-3, "timestamp_ms": 1e-3, "time_us": 1e-6, "timestamp_us": 1e-6}
FINER |= {"t_us": 1e-6, "time_ns": 1e-9, "timestamp_ns": 1e-9, "t_ns": 1e-9}
"""Names that tell another unit, with that unit in seconds."""

_NEED = "an undamaged MAT file"
_NUMBERS = "fiub"  # kinds of numbers of NumPy
_MOST_IN_ARRAY = 100  # elements of an array of structs, each of which is a struct of signals
_DEEPEST = 16
_TABLES = ("table", "timetable")
_PLAIN = {"double", "single", "logical", "char", "cell", "struct", "sparse", "function_handle"}
_PLAIN |= {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}


Tree: TypeAlias = "Mapping[str, Any | Tree]"
"""Structs within structs; leaves are arrays, or datasets of HDF5 that are not read yet."""


Clock: TypeAlias = tuple[str, Any, float]
"""A vector of times: its name, its leaf, and its unit [s]."""


def open_file(path: str | os.PathLike[str], kind: Kind) -> Recording:
    """Open a MAT file and find its signals; vectors of version 7.3 are read when asked for.

    Channels are vectors, by their path in structs as in ``log.speed``. Their time is a vector of as many samples called
    time, t, timestamp or the like, in the same struct or around it, in seconds unless its name says ms, us or ns. A
    struct of Time and Data is one channel. A table is read as a struct, a timetable with its times. Raises InputError.
    """
    source = place(path)
    objects: list[str] = []
    form, opener = ("MAT 7.3", _tree_73) if kind is kinds.MAT73 else ("MAT 5", _tree_5)
    with guarded(source, _NEED):
        tree = opener(path, kind, objects)
        also, lost = _tables(path, [name for name in objects if "." in name]) if objects else ({}, [])
        series, untimed = _series({**tree, **also})
    if not series:
        there = f"; vectors without one: {listed(untimed)}" if untimed else ""
        raise InputError(
            f"{source}: has no signal with a time{there}; a time vector is needed beside the signals, called "
            f"{', '.join(TIMES[:4])}"
        )

    def load(names: tuple[str, ...]) -> dict[str, Channel]:
        refuse_cells(source, sum(_length(series[name][0]) for name in names))
        times: dict[tuple[int, float], FloatArray] = {}  # read once for all channels that have it
        channels = {}
        for name in names:
            values, (_, time, unit) = series[name]
            with guarded(f"{source}: channel {quoted(name, 80)}", _NEED):
                if (id(time), unit) not in times:
                    times[id(time), unit] = vector(time) * unit
                channels[name] = Channel(name, times[id(time), unit], vector(values))
        return channels

    left = [f"left out, no time goes with them: {listed(untimed)}"] if untimed else []
    return Recording(source, form, series, {}, left + lost, load)


def vector(leaf: Any) -> FloatArray:
    """The numbers of a vector (sample,). Raises an error of the library where they are damaged."""
    return np.array(leaf[()], dtype=np.float64).reshape(-1)


def _length(leaf: Any) -> int:
    return math.prod(leaf.shape)


def _is_vector(leaf: Any) -> bool:
    return _length(leaf) == max(leaf.shape, default=0) > 0


def _tree_5(path: str | os.PathLike[str], kind: Kind, objects: list[str]) -> Tree:
    from scipy.io import loadmat

    with opened(path, need=_NEED) as stream:
        order = stream.read(128)[126:128]
        if order not in (b"IM", b"MI"):
            raise InputError(f"{place(path)}: byte 127: {order!r} where IM or MI should be; {_NEED} is needed")
        stream.seek(0)
        content = loadmat(stream, struct_as_record=True, squeeze_me=False, chars_as_strings=True)

    def tree_of(items: Mapping[str, Any], path: str, depth: int) -> Tree:
        tree: dict[str, Any] = {}
        for name, value in items.items():
            full = f"{path}.{name}" if path else str(name)
            kind = getattr(value, "dtype", np.dtype(object))
            if type(value).__name__ in ("MatlabOpaque", "MatlabObject", "MatlabFunction"):
                objects.append(full)
            elif kind.names is not None and depth < _DEEPEST and value.size <= _MOST_IN_ARRAY:
                flat = value.reshape(-1)
                for k, one in enumerate(flat):
                    here = name if len(flat) == 1 else f"{name}({k + 1})"
                    tree[here] = tree_of({n: one[n] for n in kind.names}, full, depth + 1)
            elif kind.names is None and kind.kind in _NUMBERS and isinstance(value, np.ndarray):
                tree[str(name)] = value
        return tree

    return tree_of({k: v for k, v in content.items() if not k.startswith("__")}, "", 0)


def _tree_73(path: str | os.PathLike[str], kind: Kind, objects: list[str]) -> Tree:
    """Groups are structs. Only what lies in the file itself is followed: no links elsewhere, no data beside it."""
    h5py = library("h5py", place(path), kind)
    count = 0

    def is_number(item: Any) -> bool:
        if item.shape is None or item.dtype.kind not in _NUMBERS or item.external or item.is_virtual:
            return False
        return "MATLAB_empty" not in item.attrs and item.attrs.get("MATLAB_class", b"double") != b"char"

    def tree_of(group: Any, path: str, depth: int) -> Tree:
        nonlocal count
        tree: dict[str, Any] = {}
        for name in group:
            count += 1
            if count > 10 * MOST_COLUMNS:
                raise InputError(f"{path or 'the file'}: holds more than {10 * MOST_COLUMNS:,} variables")
            if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                continue
            full = f"{path}.{name}" if path else name
            item = group[name]
            if "MATLAB_object_decode" in item.attrs:
                objects.append(full)
            elif isinstance(item, h5py.Group):
                if depth < _DEEPEST:
                    tree[name] = tree_of(item, full, depth + 1)
            elif is_number(item):
                tree[name] = item
        return tree

    return tree_of(h5py.File(opened(path, need=_NEED), "r"), "", 0)


def _tables(path: str | os.PathLike[str], nested: list[str]) -> tuple[dict[str, Tree], list[str]]:
    """Tables of a file by name, each a tree of its columns and, for a timetable, ``time`` [s]; and remarks on what
    cannot be read.

    They are objects, whose layout in the file MATLAB does not publish. `nested`: objects that lie within structs, which
    are not looked into.
    """
    if importlib.util.find_spec("matio") is None:
        return {}, ["its tables and other objects are left out; tables need mat-io: pip install 'avtorch[mat]'"]
    try:
        import matio  # pyright: ignore[reportMissingTypeStubs]

        library: Any = matio
        classes = {name: kind for name, (_, kind) in library.whosmat(os.fspath(path)).items()}
        wanted = [name for name, kind in classes.items() if kind in _TABLES]
        content = library.load_from_mat(os.fspath(path), variable_names=wanted) if wanted else {}
        trees: dict[str, Tree] = {
            name: _columns(content[name]) for name in wanted if hasattr(content.get(name), "columns")
        }
    except Exception as fault:  # what else the file holds is read all the same
        return {}, [f"its tables and other objects are left out, mat-io cannot read them: {reason(fault)}"]
    lost = [name for name, kind in classes.items() if kind not in _PLAIN and name not in trees]
    lost += nested
    return trees, [f"timeseries and other objects cannot be read, save them as structs: {listed(lost)}"] if lost else []


def _columns(frame: Any) -> dict[str, np.ndarray]:
    """The numeric columns of a data frame; its index as ``time`` where that is of times."""
    found: dict[str, np.ndarray] = {}
    stamps = _seconds(frame.index.to_numpy())
    if stamps is not None:
        found["time"] = stamps
    for name in frame.columns:
        values = frame[name].to_numpy()
        numbers = values if values.dtype.kind in _NUMBERS else _seconds(values)
        if numbers is not None and str(name) not in found:
            found[str(name)] = numbers
    return found


def _seconds(values: np.ndarray) -> np.ndarray | None:
    """Dates and durations (row,) in seconds, as Unix time and as they are; None for anything else."""
    if values.dtype.kind not in "mM":
        return None
    return values.astype("timedelta64[ns]" if values.dtype.kind == "m" else "datetime64[ns]").astype(np.int64) * 1e-9


def _series(tree: Tree) -> tuple[dict[str, tuple[Any, Clock]], list[str]]:
    """Vectors with their clocks by path, 10,000 at most, and the paths of those that no time goes with."""
    series: dict[str, tuple[Any, Clock]] = {}
    untimed: list[str] = []

    def visit(tree: Tree, path: str, outer: Clock | None, depth: int) -> None:
        if depth > _DEEPEST or len(series) >= MOST_COLUMNS:
            return
        own = _clock(tree)
        clock = own or outer
        names = [name for name in tree if own is None or name != own[0]]
        for name in names:
            item = tree[name]
            full = f"{path}.{name}" if path else name
            if isinstance(item, Mapping):
                visit(item, full, clock, depth + 1)
            elif clock is not None and _is_vector(item) and _length(item) == _length(clock[1]) > 1:
                # a struct of Time and Data alone is one signal, called as the struct is
                alone = path and own is not None and len(names) == 1 and name.lower() in ("data", "values", "value")
                series[path if alone else full] = item, clock
            elif _length(item) > 1:
                untimed.append(full)

    visit(tree, "", None, 0)
    return series, untimed


def _clock(tree: Tree) -> Clock | None:
    lower = {name.lower(): name for name in reversed(list(tree))}
    for wanted, scale in [*((name, 1.0) for name in TIMES), *FINER.items()]:
        name = lower.get(wanted)
        if name is not None and not isinstance(tree[name], Mapping) and _is_vector(tree[name]):
            return name, tree[name], scale
    return None
