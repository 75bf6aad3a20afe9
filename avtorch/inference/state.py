"""Saved states checked against the streams that load them: accepted as a whole, or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.device import generator_on


def shaped_as(own: Any, given: Any, place: str) -> None:
    """Check `given` against `own`: the same keys, types, dtypes and shapes, and finite numbers throughout.

    Raises:
        InputError: that names the `place` within the state.
    """
    if isinstance(own, Tensor):
        tensor_as(given, own.dtype, tuple(own.shape), place)
    elif isinstance(own, Mapping):
        if not isinstance(given, dict) or set(given) != set(own):
            found = f"found {_keys(given)}" if isinstance(given, dict) else f"found a {type(given).__name__}"
            raise InputError(f"{place}: {found}, needs {_keys(own)}")
        for key, value in own.items():
            shaped_as(value, given[key], f"{place}.{key}")
    elif isinstance(own, (list, tuple)):
        if type(given) is not type(own) or len(given) != len(own):
            raise InputError(f"{place}: found {_words(given)}, needs {len(own)} entries")
        for i, value in enumerate(own):
            shaped_as(value, given[i], f"{place}[{i}]")
    elif type(given) is not type(own):
        raise InputError(f"{place}: found a {type(given).__name__}, needs a {type(own).__name__}")


def tensor_as(given: Any, dtype: torch.dtype, shape: tuple[int, ...], place: str, *, finite: bool = True) -> None:
    """Check a tensor's dtype and shape against these; its numbers must be finite unless `finite` is False.

    Raises:
        InputError: that names the `place` within the state.
    """
    if type(given) is not Tensor or given.layout is not torch.strided or given.device.type != "cpu":
        raise InputError(f"{place}: found a {type(given).__name__}, needs a plain tensor")
    if given.dtype != dtype or tuple(given.shape) != shape:
        raise InputError(f"{place}: found {given.dtype} of shape {tuple(given.shape)}, needs {dtype} of {shape}")
    if finite and dtype.is_floating_point and not bool(given.isfinite().all()):
        raise InputError(f"{place}: holds numbers that are not finite")


def about(state: Any, *more: str) -> tuple[Any, ...]:
    """The identity of a state: the values of `more`, the parameters' names, the number of vehicles; None where
    missing."""
    given = state if isinstance(state, dict) else {}
    names, mean = given.get("names"), given.get("mean")
    plain = tuple(str(name)[:40] for name in names) if isinstance(names, (list, tuple)) else None
    return *(given.get(key) for key in more), plain, len(mean) if isinstance(mean, Tensor) and mean.ndim else None


def generator_of(state: Tensor, place: str, device: torch.device) -> torch.Generator:
    """A generator of the device in this state.

    Raises:
        InputError: where it is no generator's state.
    """
    made = generator_on(device, 0)
    try:
        made.set_state(state)
    except (RuntimeError, TypeError) as fault:
        raise InputError(f"{place}: is no state of a generator ({str(fault).splitlines()[0]})") from None
    return made


def _keys(x: Mapping[Any, Any]) -> str:
    return ", ".join(sorted(str(key)[:40] for key in x)[:20]) or "nothing"


def _words(x: Any) -> str:
    return f"{len(x)} entries" if isinstance(x, (list, tuple)) else f"a {type(x).__name__}"
