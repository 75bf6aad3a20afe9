"""Rows for the latent form: one or many windows of command, measured acceleration and/or speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from avtorch.arrays import Bool, Float, Int, Real
from avtorch.errors import InputError
from avtorch.inference.device import Device

#: A step longer than this many median steps is a gap: the filter starts afresh behind it.
GAP = 2.5


@dataclass(frozen=True)
class LatentWindow:
    """Rows of one or many windows, ``(window, time)`` float64, shorter ones padded at the end with ``mask`` False.

    ``time`` [s]; ``u`` [m/s²] held from its row to the next; ``accel`` [m/s²] and/or ``speed`` [m/s] as measured, or
    None; ``mask`` True where a row may be used (engaged, moving).
    """

    time: Float[Tensor, "window time"]
    u: Float[Tensor, "window time"]
    accel: Float[Tensor, "window time"] | None
    speed: Float[Tensor, "window time"] | None
    mask: Bool[Tensor, "window time"]

    def __post_init__(self) -> None:
        if self.accel is None and self.speed is None:
            raise InputError("accel, speed: neither was given; the latent form needs at least one measured signal")
        if self.time.ndim != 2:
            raise InputError(f"time: has {self.time.ndim} dimensions; expected 2, (window, time)")
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None and value.shape != self.time.shape:
                raise InputError(f"{field.name}: has shape {tuple(value.shape)}; time has {tuple(self.time.shape)}")
        if bool(((self.time.diff() <= 0) & self.mask[:, 1:] & self.mask[:, :-1]).any()):
            raise InputError("time: does not increase from row to row")
        for name in ("u", "accel", "speed"):
            value = getattr(self, name)
            if value is not None and not bool(torch.isfinite(value[self.mask]).all()):
                raise InputError(f"{name}: is not finite in every row that is used")

    @property
    def windows(self) -> int:
        return self.time.shape[0]

    @classmethod
    def single(
        cls,
        time: Real[Tensor, " time"],
        u: Real[Tensor, " time"],
        *,
        accel: Real[Tensor, " time"] | None = None,
        speed: Real[Tensor, " time"] | None = None,
        mask: Bool[Tensor, " time"] | Real[Tensor, " time"] | None = None,
    ) -> LatentWindow:
        """One window from rows ``(time,)``."""

        def row(value: Tensor | None) -> Tensor | None:
            return None if value is None else torch.as_tensor(value, dtype=torch.float64)[None]

        t = torch.as_tensor(time, dtype=torch.float64)[None]
        c = torch.as_tensor(u, dtype=torch.float64)[None]
        used = torch.ones_like(t, dtype=torch.bool) if mask is None else torch.as_tensor(mask, dtype=torch.bool)[None]
        return cls(t, c, row(accel), row(speed), used)

    @classmethod
    def stack(cls, windows: Sequence[LatentWindow]) -> LatentWindow:
        """Many windows as one, padded to the longest."""
        longest = max(w.time.shape[1] for w in windows)

        def pad(value: Tensor) -> Tensor:
            return torch.nn.functional.pad(value, (0, longest - value.shape[1]))

        def measured(name: str) -> Tensor | None:
            given = [pad(v) for w in windows if (v := getattr(w, name)) is not None]
            if 0 < len(given) < len(windows):
                raise InputError(f"{name}: measured in some windows only; give it for all of them or for none")
            return torch.cat(given) if given else None

        time, u, mask = (torch.cat([pad(getattr(w, name)) for w in windows]) for name in ("time", "u", "mask"))
        return cls(time, u, measured("accel"), measured("speed"), mask)

    def select(self, index: Int[Tensor, " chosen"] | Bool[Tensor, " window"]) -> LatentWindow:
        """The windows named by ``index``."""
        accel = None if self.accel is None else self.accel[index]
        speed = None if self.speed is None else self.speed[index]
        return LatentWindow(self.time[index], self.u[index], accel, speed, self.mask[index])

    def to(self, device: Device) -> LatentWindow:
        """The same rows on another device."""
        accel, speed = (None if x is None else x.to(device) for x in (self.accel, self.speed))
        return LatentWindow(self.time.to(device), self.u.to(device), accel, speed, self.mask.to(device))

    def runs(self) -> tuple[LatentWindow, Int[Tensor, " run"]]:
        """Stretches without a gap or an unused row, one a row, and the window ``(run,)`` each comes from.

        After a gap, a standstill or a driver's override the acceleration is unknown, so each run starts afresh.
        """
        pieces: list[LatentWindow] = []
        owner: list[int] = []
        for w in range(self.windows):
            rows = self.mask[w].nonzero()[:, 0]
            if not len(rows):
                continue
            step = self.time[w, rows].diff()
            usual = step.median() if len(step) else torch.tensor(0.0)
            cut = ((rows.diff() > 1) | (step > GAP * usual)).nonzero()[:, 0] + 1
            for piece in torch.tensor_split(rows, cut.cpu()):
                pieces.append(
                    LatentWindow.single(
                        self.time[w, piece],
                        self.u[w, piece],
                        accel=None if self.accel is None else self.accel[w, piece],
                        speed=None if self.speed is None else self.speed[w, piece],
                    )
                )
                owner.append(w)
        if not pieces:
            raise InputError("mask: no row of any window may be used")
        return LatentWindow.stack(pieces), torch.tensor(owner, device=self.time.device)
