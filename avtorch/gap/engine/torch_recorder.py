"""The recorder in torch: signals of the grid as coefficients of the channels, batched and differentiable.

Twin of `Hypothesis.recorded` and `DriveData.transform`, with gradients in the signals and in delays and filters. The
delay reads between points of the grid, so that the gradient in it jumps where a row passes one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.engine.drive_data import DriveData, filtered
from avtorch.gap.engine.torch_plant import Values


@dataclass(frozen=True, eq=False)
class TorchRecorder:
    """The recorder of `data`; tables of rows (row,) that its steps read."""

    data: DriveData
    grid_time: Tensor
    time: Tensor
    held: tuple[Tensor, Tensor]
    aligned: tuple[Tensor, Tensor]
    span: Tensor
    inner: Tensor

    @classmethod
    def of(cls, data: DriveData) -> TorchRecorder:
        time, n = torch.as_tensor(data.time), len(data.time)
        row = torch.as_tensor(data.held(np.arange(float(n))))
        inner = np.arange(n)
        inner[data.bounds[1:] - 1] -= 1
        inner[data.bounds[:-1]] += 1
        return cls(
            data,
            torch.as_tensor(data.grid.time),
            time,
            (row.long().clamp(max=n - 2), row - row.long().clamp(max=n - 2)),
            _between(time, time - data.align_s),
            (time[2:] - time[:-2]).clamp_min(0.3 * data.dt),
            torch.as_tensor(inner) - 1,
        )

    def response(self, accel: Tensor, gained: Tensor, values: Values) -> Tensor:
        """Coefficients (column, channel, frame, bin) of a reading and a gained speed, (column, grid) each.

        `values` holds each channel's delay and filter [s], (column,).
        """
        shown = []
        if self.data.accel is not None:
            a = self._low_pass(self._late(accel, values["accel_delay"]), values["accel_filter"])
            index, share = self.aligned
            shown.append(_read(a, index, share) if self.data.align_s else a)
        if self.data.speed is not None:
            v = self._low_pass(self._late(gained, values["speed_delay"]), values["speed_filter"])
            v = v if self.data.hold == 1 else _read(v, *self.held)
            difference = (v[..., 2:] - v[..., :-2]) / self.span
            shown.append(difference[..., self.inner])
        return cast(Tensor, _Transform.apply(torch.stack(shown, -2), self.data))

    def _late(self, x: Tensor, delay: Tensor) -> Tensor:
        return _read(x, *_between(self.grid_time, self.time - delay[..., None]))

    def _low_pass(self, x: Tensor, time_constant: Tensor) -> Tensor:
        tau, step = time_constant.clamp_min(1e-4)[..., None], torch.as_tensor(self.data.gaps[1])
        keep = torch.exp(-step / tau)
        held = tau / step * (1 - keep)
        none = (time_constant < 1e-4)[..., None]
        pole = [torch.where(none, x, y) for x, y in ((0.0, keep), (1.0, 1 - held), (0.0, held - keep))]
        return cast(Tensor, _OnePole.apply(x, *pole, self.data))


def _between(time: Tensor, at: Tensor) -> tuple[Tensor, Tensor]:
    """The point of `time` (point,) at or before each of `at`, and the share of the way to the next; 0 or 1 outside."""
    index = (torch.searchsorted(time, at.detach().contiguous(), right=True) - 1).clamp(0, len(time) - 2)
    begin = time[index]
    return index, ((at - begin) / (time[index + 1] - begin)).clamp(0.0, 1.0)


def _read(x: Tensor, index: Tensor, share: Tensor) -> Tensor:
    """`x` (column, point) linearly between points."""
    index = index.expand(*x.shape[:-1], index.shape[-1])
    low = x.gather(-1, index)
    return low + share * (x.gather(-1, index + 1) - low)


class _OnePole(torch.autograd.Function):
    """`drive_data.filtered`; x (column, row), coefficients (column, gap)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, keep: Tensor, new: Tensor, old: Tensor, data: DriveData) -> Tensor:
        rows, pole = x.detach().numpy(), [c.detach().numpy() for c in (keep, new, old)]
        y = np.array([filtered(row, data.bounds, data.gaps[0], *own) for row, *own in zip(rows, *pole, strict=True)])
        ctx.x, ctx.y, ctx.pole, ctx.data = rows, y, pole, data
        return torch.as_tensor(y)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        data, on_x, on_pole = ctx.data, [], []
        for g, x, y, *pole in zip(gradient.numpy(), ctx.x, ctx.y, *ctx.pole, strict=True):
            for into, one in zip((on_x, on_pole), _adjoint(g, x, y, data.bounds, data.gaps[0], *pole), strict=True):
                into.append(one)
        return torch.as_tensor(np.array(on_x)), *torch.as_tensor(np.array(on_pole)).movedim(1, 0), None


@njit(cache=True, error_model="numpy")
def _adjoint(
    g: FloatArray,
    x: FloatArray,
    y: FloatArray,
    bounds: IntArray,
    gaps: IntArray,
    keep: FloatArray,
    new: FloatArray,
    old: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Gradients on x (row,) and on the coefficients (keep, new, old; gap) of `drive_data.filtered`, from `g` (row,)."""
    on_x, on_pole = np.zeros(len(x)), np.zeros((3, len(keep)))
    for s in range(len(bounds) - 1):
        costate = 0.0
        for i in range(bounds[s + 1] - 1, bounds[s], -1):
            k = gaps[i]
            costate += g[i]
            on_x[i] += new[k] * costate
            on_x[i - 1] += old[k] * costate
            on_pole[0, k] += costate * y[i - 1]
            on_pole[1, k] += costate * x[i]
            on_pole[2, k] += costate * x[i - 1]
            costate *= keep[k]
        on_x[bounds[s]] += costate + g[bounds[s]]
    return on_x, on_pole


class _Transform(torch.autograd.Function):
    """Rows (..., row) as coefficients (..., frame, bin), a linear map."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, data: DriveData) -> Tensor:
        ctx.data = data
        flat = data.transform(list(rows.detach().reshape(-1, rows.shape[-1]).numpy()))
        return torch.as_tensor(flat).reshape(*rows.shape[:-1], *flat.shape[1:])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        flat = gradient.reshape(-1, *gradient.shape[-2:]).numpy()
        rows = np.stack([ctx.data.adjoint(x) for x in flat])
        return torch.as_tensor(rows).reshape(*gradient.shape[:-2], -1), None
