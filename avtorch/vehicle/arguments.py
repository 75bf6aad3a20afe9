"""Numbers and tensors as the vehicle takes them: checked once, on entry, then trusted in the hot loop.

Broadcasting with types: torch declares none for it, and its own `broadcast_shapes` imports SymPy, which takes almost as
long as torch itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float, Real
from avtorch.errors import InputError

Number: TypeAlias = float | int | Tensor

Batch: TypeAlias = Float[Tensor, "*#batch"]
"""A tensor that broadcasts with the others of a call."""

Signal: TypeAlias = Float[Tensor, "*#batch time"]
"""Such tensors along a last dimension of time."""

Batched: TypeAlias = float | int | Real[Tensor, "*#batch"]
"""A number, or a tensor that broadcasts with the others of a call."""


def tensor(value: object, *, dtype: torch.dtype | None = None) -> Tensor:
    """`value` as a floating tensor: tensors keep their dtype, everything else becomes float64 (or `dtype`)."""
    if isinstance(value, Tensor):
        return value if value.is_floating_point() else value.to(dtype or torch.float64)
    return torch.as_tensor(value, dtype=dtype or torch.float64)


def checked(
    name: str,
    value: object,
    *,
    unit: str = "",
    above: float | None = None,
    least: float | None = None,
    dtype: torch.dtype | None = None,
) -> Tensor:
    """`value` as a tensor, all finite, `> above` and `>= least`; raises an `InputError` that names the argument."""
    try:
        out = tensor(value, dtype=dtype)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{name}: found {value!r}, needs a number or a tensor of numbers") from None
    right = "finite" + (f" and > {above:g}" if above is not None else f" and >= {least:g}" if least is not None else "")
    right += f" {unit}" if unit else ""
    seen = out.detach()
    bad = ~torch.isfinite(seen)
    if above is not None:
        bad |= seen <= above
    if least is not None:
        bad |= seen < least
    if bool(bad.any()):
        raise InputError(f"{name}: found {seen[bad].reshape(-1)[0].item():g}, needs {right}")
    return out


def broadcast(*tensors: Tensor) -> tuple[Tensor, ...]:
    """`tensors` expanded to the shape that they broadcast to; see `torch.broadcast_tensors`."""
    return torch.broadcast_tensors(*tensors)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """The shape that `shapes` broadcast to. Raises `RuntimeError` where there is none."""
    try:
        return torch.Size(np.broadcast_shapes(*(tuple(shape) for shape in shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from None
