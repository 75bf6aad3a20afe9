"""Broadcasting with types: torch declares none for these two."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def broadcast(*tensors: Tensor) -> tuple[Tensor, ...]:
    """`tensors` expanded to the shape that they broadcast to; see `torch.broadcast_tensors`."""
    return torch.broadcast_tensors(*tensors)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """The shape that `shapes` broadcast to. Raises `RuntimeError` where there is none."""
    return torch.broadcast_shapes(*shapes)  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
