"""MATLAB's tables and timetables: objects, whose layout in the file MATLAB does not publish, by mat-io."""

from __future__ import annotations

import importlib.util
import os
from typing import Any

import numpy as np

from avtorch.errors import listed
from avtorch.io.formats.library import reason, silenced
from avtorch.io.formats.mat_tree import Loaded, Tree

_TABLES = ("table", "timetable")
_PLAIN = {"double", "single", "logical", "char", "cell", "struct", "sparse", "function_handle"}
_PLAIN |= {f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)}


def tables(path: str | os.PathLike[str], nested: list[str]) -> tuple[dict[str, Tree], list[str]]:
    """Tables of a file by name, each a tree of its columns and, for a timetable, ``time`` [s]; and remarks on what
    cannot be read.

    `nested`: objects that lie within structs, which are not looked into.
    """
    if importlib.util.find_spec("matio") is None:
        return {}, ["its tables and other objects are left out; tables need mat-io: pip install 'avtorch[mat]'"]
    try:
        with silenced():
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


def _columns(frame: Any) -> dict[str, Loaded]:
    """The numeric columns of a data frame; its index as ``time`` where that is of times."""
    found: dict[str, Loaded] = {}
    stamps = _seconds(frame.index.to_numpy())
    if stamps is not None:
        found["time"] = Loaded(stamps)
    for name in frame.columns:
        values = frame[name].to_numpy()
        numbers = values if values.dtype.kind in "fiub" else _seconds(values)
        if numbers is not None and str(name) not in found:
            found[str(name)] = Loaded(numbers)
    return found


def _seconds(values: np.ndarray) -> np.ndarray | None:
    """Dates and durations (row,) in seconds, as Unix time and as they are; None for anything else."""
    if values.dtype.kind not in "mM":
        return None
    return values.astype("timedelta64[ns]" if values.dtype.kind == "m" else "datetime64[ns]").astype(np.int64) * 1e-9
