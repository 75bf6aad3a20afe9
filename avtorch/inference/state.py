"""Saved states against those who load them: of the same parameters, vehicles and draws, or refused as a whole.

What was damaged on its way is found by the checksum of the file that holds it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from avtorch.errors import InputError


def shaped_as(own: Any, given: Any, place: str) -> None:
    """Check `given` against `own`: the same keys, types, dtypes and shapes, and finite numbers throughout.

    Raises `InputError` that names the `place` within the state.
    """
    if isinstance(own, Tensor):
        if not isinstance(given, Tensor) or given.dtype != own.dtype or given.shape != own.shape:
            found = f"{given.dtype} of shape {tuple(given.shape)}" if isinstance(given, Tensor) else _kind(given)
            raise InputError(f"{place}: found {found}, needs {own.dtype} of shape {tuple(own.shape)}")
        if own.dtype.is_floating_point and not bool(given.isfinite().all()):
            raise InputError(f"{place}: holds numbers that are not finite")
    elif type(given) is not type(own):
        raise InputError(f"{place}: found {_kind(given)}, needs {_kind(own)}")
    elif isinstance(own, Mapping):
        if set(given) != set(own):
            found, needed = (", ".join(sorted(map(str, x)))[:200] or "nothing" for x in (given, own))
            raise InputError(f"{place}: found {found}, needs {needed}")
        for key, value in own.items():
            shaped_as(value, given[key], f"{place}.{key}")
    elif isinstance(own, (list, tuple)):
        if len(given) != len(own):
            raise InputError(f"{place}: found {len(given)} entries, needs {len(own)}")
        for i, value in enumerate(own):
            shaped_as(value, given[i], f"{place}[{i}]")


def _kind(x: Any) -> str:
    return f"a {type(x).__name__}"
