"""Broadcasting with types: torch declares none for these two, and its own `broadcast_shapes` imports SymPy, which takes
almost as long as torch itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor


def broadcast(*tensors: Tensor) -> tuple[Tensor, ...]:
    """`tensors` expanded to the shape that they broadcast to; see `torch.broadcast_tensors`."""
    return torch.broadcast_tensors(*tensors)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """The shape that `shapes` broadcast to. Raises `RuntimeError` where there is none."""
    try:
        return torch.Size(np.broadcast_shapes(*(tuple(shape) for shape in shapes)))
    except ValueError as error:
        raise RuntimeError(str(error)) from None
