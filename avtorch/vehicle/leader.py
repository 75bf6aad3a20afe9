"""The vehicle in front: position, speed and acceleration at every tick, consistent with one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Float, FloatArray
from avtorch.errors import InputError

#: Standard deviation of the Gaussian that smooths the acceleration [s]. The drive cycles are given once a second, so
#: nothing above 0.5 Hz is known; half a second passes 29 % there and 0.7 % at 1 Hz. For 10 Hz recordings the same
#: width removes the steps of differenced GPS speed and keeps every manoeuvre a driver makes.
SMOOTH_S = 0.5


@dataclass(frozen=True)
class Leader:
    """`position` [m], `speed` [m/s] >= 0, `accel` [m/s²], each (time,) or (scenario, time), at `time` (time,) [s].

    `time` starts at 0 in steps of `dt` [s]; float64. Raises `InputError` for shapes that differ.

    Example:
        >>> from avtorch import Leader
        >>> leader = Leader.from_speed(time=[0.0, 5.0, 10.0], speed=[20.0, 15.0, 20.0], smooth_s=0.0)
        >>> leader.duration, tuple(leader.speed.shape)
        (10.0, (1001,))
        >>> leader.accel[[250, 750]].round(decimals=2).tolist()
        [-1.0, 1.0]
    """

    time: Float[Tensor, " time"]
    position: Float[Tensor, "*scenario time"]
    speed: Float[Tensor, "*scenario time"]
    accel: Float[Tensor, "*scenario time"]
    dt: float
    name: str = "leader"

    def __post_init__(self) -> None:
        if not self.position.shape == self.speed.shape == self.accel.shape:
            raise InputError("leader: position, speed and accel differ in shape")
        if self.time.dim() != 1 or self.time.shape[-1] != self.speed.shape[-1]:
            raise InputError(f"leader: found {self.time.shape} times for {tuple(self.speed.shape)} speeds")

    @property
    def duration(self) -> float:
        """Seconds from the first tick to the last."""
        return (self.time.shape[-1] - 1) * self.dt

    @classmethod
    def from_speed(
        cls,
        time: Sequence[float] | np.ndarray | Tensor,
        speed: Sequence[float] | np.ndarray | Tensor,
        dt: float = 0.01,
        smooth_s: float = SMOOTH_S,
        name: str = "leader",
    ) -> Leader:
        """A leader from recorded `speed` [m/s] at `time` [s] (any spacing, both (time,)), resampled to `dt` [s].

        Shape-preserving cubic (PCHIP) interpolation, its acceleration smoothed by a Gaussian of `smooth_s` [s] (0:
        none), then integrated to speed and position. The acceleration is continued evenly beyond both ends, so the
        first and last speed stay as recorded and, the kernel being positive, no speed falls below zero.

        Raises `InputError` for fewer than two samples, times that do not increase, speeds that are negative or not
        finite, `dt <= 0` or `smooth_s < 0`.
        """
        t, v = (np.asarray(x, dtype=np.float64).reshape(-1) for x in (time, speed))
        if len(t) != len(v) or len(t) < 2:
            raise InputError(f"leader {name}: found {len(t)} times and {len(v)} speeds, needs two or more of each")
        if not 0 < dt < np.inf or not 0 <= smooth_s < np.inf:
            raise InputError(f"leader {name}: found dt {dt!r}, smooth_s {smooth_s!r}, needs dt > 0 and smooth_s >= 0")
        for what, bad in (("a speed that is not finite", ~np.isfinite(v)), ("a negative speed", v < 0)):
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(f"leader {name}: found {what} ({v[row]:g} m/s) in sample {row}, needs >= 0 m/s")
        if not np.isfinite(t).all() or (np.diff(t) <= 0).any():
            row = int(np.argmax(~np.isfinite(t) | (np.diff(t, prepend=-np.inf) <= 0)))
            raise InputError(f"leader {name}: found time {t[row]:g} s in sample {row}, needs strictly increasing times")
        steps = int(np.floor((t[-1] - t[0]) / dt + 1e-9))
        if steps < 1:
            raise InputError(f"leader {name}: found {t[-1] - t[0]:g} s, needs at least one step of dt = {dt:g} s")
        grid = np.arange(steps + 1) * dt
        # imported here: a log that is estimated or diagnosed needs no leader, and these take a quarter of a second
        from scipy.interpolate import PchipInterpolator  # pyright: ignore[reportMissingTypeStubs]
        from scipy.ndimage import (  # pyright: ignore[reportMissingTypeStubs]
            gaussian_filter1d,  # pyright: ignore[reportUnknownVariableType]
        )

        raw = PchipInterpolator(t, v)(np.minimum(t[0] + grid, t[-1]))
        # mean acceleration of each step: summing these gives back the speed exactly
        mean_accel: FloatArray = np.diff(raw) / dt
        if smooth_s > 0:
            mean_accel = cast(FloatArray, gaussian_filter1d(mean_accel, smooth_s / dt, mode="reflect", truncate=6.0))
        smooth = np.maximum(raw[0] + np.concatenate([[0.0], np.cumsum(mean_accel) * dt]), 0.0)  # rounding only
        accel = np.concatenate([mean_accel[:1], 0.5 * (mean_accel[1:] + mean_accel[:-1]), mean_accel[-1:]])
        # trapezoid with the end correction of Euler and Maclaurin: fourth order
        moved = 0.5 * dt * (smooth[1:] + smooth[:-1]) - dt * dt / 12 * np.diff(accel)
        position = np.concatenate([[0.0], np.cumsum(moved)])
        return cls(*(torch.as_tensor(x) for x in (grid, position, smooth, accel)), dt=dt, name=name)

    @classmethod
    def default(cls, *, start: float = 0.0, duration: float | None = None, dt: float = 0.01) -> Leader:
        """US06, from second `start` of the cycle on, to its end or for `duration` [s].

        The first 80 s hold a standstill of 5 s, a pull-off to 20 m/s, a full stop of 8 s, and a second pull-off.
        `start=48` begins with that one.
        """
        from avtorch.io.us06 import US06_SPEED_MPS

        whole = cls.from_speed(np.arange(len(US06_SPEED_MPS)), US06_SPEED_MPS, dt=dt, name="US06")
        return whole.section(start, duration)

    @classmethod
    def read(
        cls,
        path: str | Path,
        *,
        vehicle: int | None = None,
        event: int | None = None,
        start: float = 0.0,
        duration: float | None = None,
        dt: float = 0.01,
        smooth_s: float = SMOOTH_S,
    ) -> Leader:
        """A recorded leader: OpenACC (AstaZero, ZalaZONE), NGSIM, I-24 or a plain CSV of time and speed.

        `vehicle` and `event` choose within the file (`avtorch.io.read_leader`); `start` and `duration` [s] cut it.
        Raises `InputError` as the reader does.
        """
        from avtorch.io import read_leader

        raw = read_leader(path, vehicle=vehicle, event=event)
        whole = cls.from_speed(raw.time, raw.speed, dt=dt, smooth_s=smooth_s, name=raw.name)
        return whole.section(start, duration) if start or duration is not None else whole

    @classmethod
    def constant(cls, speed: float, duration: float, dt: float = 0.01) -> Leader:
        """A leader at constant `speed` [m/s] for `duration` [s]."""
        return cls.from_speed([0.0, duration], [speed, speed], dt=dt, smooth_s=0.0, name=f"{speed:g} m/s")

    def section(self, start: float, duration: float | None = None) -> Leader:
        """The part from `start` [s] for `duration` [s] (None: to the end), with time and position from 0.

        Raises `InputError` where the leader does not cover it.
        """
        first = round(start / self.dt)
        count = self.time.shape[-1] - first - 1 if duration is None else round(duration / self.dt)
        if first < 0 or count < 1 or first + count >= self.time.shape[-1]:
            asked = "the end" if duration is None else f"{start + duration:g} s"
            raise InputError(f"leader {self.name}: found {self.duration:g} s, section asked: {start:g} s to {asked}")
        cut = slice(first, first + count + 1)
        position = self.position[..., cut]
        return Leader(
            self.time[: count + 1],
            position - position[..., :1],
            self.speed[..., cut],
            self.accel[..., cut],
            self.dt,
            self.name,
        )
