"""The recorder in torch: signals of the grid as coefficients of the channels, batched and differentiable.

Twin of `Hypothesis.recorded` and `DriveData.transform`, with gradients in the signals and in delays and filters. The
delay reads between points of the grid, so that the gradient in it jumps where a row passes one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import numpy as np
import torch
from scipy.signal import lfilter
from torch import Tensor
from torch.autograd.function import once_differentiable

from avtorch.gap.engine.drive_data import DriveData
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
        tau = time_constant.clamp_min(1e-4)
        keep = torch.exp(-self.data.dt / tau)
        held = tau / self.data.dt * (1 - keep)
        none = time_constant < 1e-4
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
    """`drive_data.one_pole`, from y = x at the start of a stretch on; x (column, row), coefficients (column,)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, keep: Tensor, new: Tensor, old: Tensor, data: DriveData) -> Tensor:
        rows, pole = x.detach().numpy(), [c.detach().numpy() for c in (keep, new, old)]
        y = np.empty_like(rows)
        for column, (k, n, o) in enumerate(zip(*pole, strict=True)):
            for i, j in pairwise(data.bounds):
                y[column, i:j] = lfilter([n, o], [1, -k], rows[column, i:j], zi=[(1 - n) * rows[column, i]])[0]
        ctx.x, ctx.y, ctx.pole, ctx.data = rows, y, pole, data
        return torch.as_tensor(y)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        g, on_x, on_pole = gradient.numpy(), np.empty_like(ctx.x), np.zeros((3, len(ctx.x)))
        for column, (k, n, o) in enumerate(zip(*ctx.pole, strict=True)):
            for i, j in pairwise(ctx.data.bounds):
                costate = lfilter([1.0], [1, -k], g[column, i:j][::-1])[::-1]
                x, y, later = ctx.x[column, i:j], ctx.y[column, i:j], costate[1:]
                on_x[column, i:j] = n * costate
                on_x[column, i] = costate[0]
                on_x[column, i : j - 1] += o * later
                on_pole[:, column] += later @ y[:-1], later @ x[1:], later @ x[:-1]
        return torch.as_tensor(on_x), *torch.as_tensor(on_pole), None


class _Transform(torch.autograd.Function):
    """Rows (..., row) as coefficients (..., frame, bin), a linear map."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, data: DriveData) -> Tensor:
        ctx.data = data
        flat = data.transform(list(rows.detach().reshape(-1, rows.shape[-1]).numpy()))
        return torch.as_tensor(flat).reshape(*rows.shape[:-1], *flat.shape[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return cast(Tensor, _Adjoint.apply(gradient, ctx.data)), None


class _Adjoint(torch.autograd.Function):
    """Coefficients (..., frame, bin) as rows (..., row), the transpose of `_Transform`."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, data: DriveData) -> Tensor:
        ctx.data = data
        flat = coefficients.detach().reshape(-1, *coefficients.shape[-2:]).numpy()
        return torch.as_tensor(np.stack([data.adjoint(x) for x in flat])).reshape(*coefficients.shape[:-2], -1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return cast(Tensor, _Transform.apply(gradient, ctx.data)), None
