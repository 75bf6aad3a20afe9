"""MAT files: version 5 by SciPy, read when opened; version 7.3 by h5py, vectors read when asked for."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from avtorch.arrays import FloatArray
from avtorch.errors import InputError, listed, quoted
from avtorch.io.formats import kinds
from avtorch.io.formats.kinds import Kind
from avtorch.io.formats.library import guarded, library
from avtorch.io.formats.listed import Listed, refuse_cells
from avtorch.io.formats.mat_tables import tables
from avtorch.io.formats.mat_tree import TIMES, Found, Loaded, Matrix, Series, Tree, find_series, vector
from avtorch.io.formats.opened import opened
from avtorch.io.opening import place, read_regular
from avtorch.io.recording import Channel
from avtorch.io.size import MOST_BYTES, MOST_COLUMNS

_NEED = "an undamaged MAT file"
_NUMBERS = "fiub"  # kinds of numbers of NumPy
_DEEPEST = 16
_MOST_IN_ARRAY = 100  # elements of an array of structs, each of which is a struct of signals


class MatRecording(Listed):
    """A MAT file. Channels are vectors, by their path in structs as in ``log.speed``, columns as ``wheel(2)``.

    Their time is a vector of as many samples called time, t, timestamp or the like, in the same struct or around it,
    in seconds unless its name says ms, us or ns. A struct of Time and Data is one channel. A table is read as
    a struct, a timetable with its times.
    """

    def __init__(self, source: str, form: str, found: Found, remarks: Sequence[str]) -> None:
        if not found.series:
            there = f"; vectors without one: {listed(found.untimed)}" if found.untimed else ""
            raise InputError(
                f"{source}: has no signal with a time{there}; a time vector is needed beside the signals, called "
                f"{', '.join(TIMES[:4])}"
            )
        super().__init__(source, form, found.series, {}, remarks)
        self._series = found.series

    def _read(self, names: tuple[str, ...]) -> dict[str, Channel]:
        refuse_cells(self.source, sum(int(np.prod(self._series[name].time.shape)) for name in names))
        # the time and a matrix are read once for all channels that they have
        loaded: dict[int, FloatArray] = {}
        times: dict[tuple[int, float], FloatArray] = {}

        def load(matrix: Matrix) -> FloatArray:
            if id(matrix) not in loaded:
                loaded[id(matrix)] = matrix.load()
            return loaded[id(matrix)]

        channels = {}
        for name in names:
            series: Series = self._series[name]
            with guarded(f"{self.source}: channel {quoted(name, 80)}", _NEED):
                key = (id(series.time), series.scale)
                if key not in times:
                    stamps = load(series.time).reshape(-1)
                    times[key] = stamps * series.scale if series.scale != 1.0 else stamps.copy()
                channels[name] = Channel(name, times[key], vector(series, load))
        return channels


def open_file(path: str | os.PathLike[str], kind: Kind) -> MatRecording:
    """Open a MAT file and find its signals. Raises InputError."""
    return _open_73(path, kind) if kind is kinds.MAT73 else _open_5(path)


def _untimed(found: Found) -> list[str]:
    return [f"left out, no time goes with them: {listed(found.untimed)}"] if found.untimed else []


# version 5 --------------------------------------------------------------------------------------------------


def _open_5(path: str | os.PathLike[str]) -> MatRecording:
    source = place(path)
    raw = read_regular(path, most=MOST_BYTES, need=_NEED)
    if raw[126:128] not in (b"IM", b"MI"):
        raise InputError(f"{source}: byte 127: {raw[126:128]!r} where IM or MI should be; {_NEED} is needed")
    import io

    from scipy.io import loadmat

    with guarded(source, _NEED):
        content = loadmat(io.BytesIO(raw), struct_as_record=True, squeeze_me=False, chars_as_strings=True)
        objects: list[str] = []
        tree = _tree_5({k: v for k, v in content.items() if not k.startswith("__")}, "", objects, 0)
        also, lost = _tables(path, objects)
        found = find_series({**tree, **also})
    return MatRecording(source, "MAT 5", found, _untimed(found) + lost)


def _tables(path: str | os.PathLike[str], objects: list[str]) -> tuple[dict[str, Tree], list[str]]:
    return tables(path, [name for name in objects if "." in name]) if objects else ({}, [])


def _tree_5(items: Any, path: str, objects: list[str], depth: int) -> Tree:
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
                tree[here] = _tree_5({n: one[n] for n in kind.names}, full, objects, depth + 1)
        elif kind.names is None and kind.kind in _NUMBERS and isinstance(value, np.ndarray):
            tree[str(name)] = Loaded(value)
    return tree


# version 7.3 ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Stored:
    dataset: Any
    shape: tuple[int, ...]

    def load(self) -> FloatArray:
        return np.array(self.dataset[()], dtype=np.float64).T


def _open_73(path: str | os.PathLike[str], kind: Kind) -> MatRecording:
    source = place(path)
    h5py = library("h5py", source, kind)
    stream = opened(Path(path), need=_NEED)
    try:
        with guarded(source, _NEED):
            file = h5py.File(stream, "r")
            objects: list[str] = []
            tree = _tree_73(h5py, file, "", objects, 0, [0])
            also, lost = _tables(path, objects)
            found = find_series({**tree, **also})
        recording = MatRecording(source, "MAT 7.3", found, _untimed(found) + lost)
    except BaseException:
        stream.close()
        raise
    weakref.finalize(recording, _close, file, stream)
    return recording


def _close(file: Any, stream: Any) -> None:
    file.close()
    stream.close()


def _tree_73(h5py: Any, group: Any, path: str, objects: list[str], depth: int, count: list[int]) -> Tree:
    """Groups are structs. Only what lies in the file itself is followed: no links elsewhere, no data beside it."""
    tree: dict[str, Any] = {}
    for name in group:
        count[0] += 1
        if count[0] > 10 * MOST_COLUMNS:
            raise InputError(f"{path or 'the file'}: holds more than {10 * MOST_COLUMNS:,} variables")
        if name.startswith("#") or not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        full = f"{path}.{name}" if path else name
        item = group[name]
        if "MATLAB_object_decode" in item.attrs:
            objects.append(full)
        elif isinstance(item, h5py.Group):
            if depth < _DEEPEST:
                tree[name] = _tree_73(h5py, item, full, objects, depth + 1, count)
        elif _is_number_73(item):
            tree[name] = _Stored(item, tuple(reversed(item.shape)))
    return tree


def _is_number_73(item: Any) -> bool:
    if item.shape is None or item.dtype.kind not in _NUMBERS or item.external or item.is_virtual:
        return False
    return "MATLAB_empty" not in item.attrs and item.attrs.get("MATLAB_class", b"double") != b"char"
