"""The input of an effect besides its signal: the signals of one row, or of whole drives at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from avtorch.errors import InputError


@dataclass(frozen=True)
class EffectContext:
    """The input of an effect besides its signal: one row (...) in simulation, whole drives (..., time) otherwise.

    `time` [s] and step `dt` [s] to the next row; `position` [m] since the drive's start; the baseline's `T_L` [s],
    `K_L` [-]; `normal`, standard normal draws for an effect that samples, None where the response is deterministic.

    Example:
        >>> import torch
        >>> from avtorch.gap import AerodynamicDrag, EffectContext
        >>> speed, one = torch.tensor([10.0, 30.0]), torch.tensor(1.0)
        >>> time, dt, T_L = torch.tensor([0.0, 0.1]), 0.1 * one, 0.3 * one
        >>> row = EffectContext(time, dt, measured_speed=speed, travelled=None, T_L=T_L, K_L=one)
        >>> [round(a, 2) for a in AerodynamicDrag(4e-4).apply(0 * speed, row).tolist()]
        [-0.04, -0.36]
    """

    time: Tensor
    dt: Tensor
    measured_speed: Tensor | None
    travelled: Tensor | None
    T_L: Tensor
    K_L: Tensor
    normal: Tensor | None = None
    whole: bool = True

    @property
    def speed(self) -> Tensor:
        """[m/s], not below 0; the measured speed, if the drive is a log. Raises `InputError` if it was not measured."""
        if self.measured_speed is None:
            raise InputError("speed: not in the drive, needed by an effect that depends on it")
        return self.measured_speed.clamp_min(0.0)

    @property
    def position(self) -> Tensor:
        """[m], the integrated measured speed. Raises `InputError` where it was not measured."""
        if self.travelled is None:
            raise InputError("speed: not in the drive, needed by an effect that depends on position")
        return self.travelled


def context_at(row: EffectContext, k: int) -> EffectContext:
    """One row of a whole drive."""

    def pick(x: Tensor | None) -> Any:
        return None if x is None else x if x.dim() == 0 else x[..., 0 if x.shape[-1] == 1 else k]

    parts = (row.time, row.dt, row.measured_speed, row.travelled, row.T_L, row.K_L, row.normal)
    return EffectContext(*(pick(x) for x in parts), whole=False)
