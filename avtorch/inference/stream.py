"""Samples in, one posterior per window out: the online form of the sequential loop, with a bounded memory."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import Real
from avtorch.display import Card, Displayed
from avtorch.errors import InputError
from avtorch.inference.belief import Belief
from avtorch.inference.device import Device, checked_device
from avtorch.inference.estimators import make_estimator
from avtorch.inference.form import Form
from avtorch.inference.jerk import JerkForm
from avtorch.inference.stream_units import StreamUnits
from avtorch.io import Damaged
from avtorch.io.clock import ROUNDING_S, decimals
from avtorch.io.engagement import settled_rows


def packed(state: Mapping[str, Any]) -> bytes:
    """Tensors and plain values as bytes."""
    content = io.BytesIO()
    torch.save(dict(state), content)
    return content.getvalue()


def unpacked(content: bytes, path: Path, remedy: str) -> dict[str, Any]:
    """The inverse of :func:`packed`, for the content of the file at ``path``.

    Raises `Damaged` for anything else; the message ends with ``remedy``.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            # as torch writes it, so that a small file cannot unfold into a large one
            if any(x.compress_type != zipfile.ZIP_STORED or x.file_size > len(content) for x in archive.infolist()):
                raise ValueError("compressed")
        return torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
    # torch.load has no documented list of errors
    except Exception as fault:
        reason = (str(fault).splitlines() or [type(fault).__name__])[0][:100]
        raise Damaged(f"{path}: holds no tensors and plain values ({reason}); {remedy}") from None


_PLACE = ("rows", "origin", "index", "last", "driven", "epoch")
_LONGEST_S = 1e6  # up to this distance from the first row, times keep its resolution


@dataclass(frozen=True, repr=False)
class Window(Displayed):
    """One window of every vehicle, and the belief after it.

    `start_s`, `end_s`: its bounds on the clock of the rows [s]; a row belongs to it if ``start_s <= time < end_s``.
    `n`: usable rows, ``(vehicle,)``. `belief`: see :class:`Belief`; the window was used where ``belief.excited`` and
    ``belief.converged`` hold.
    """

    start_s: float
    end_s: float
    n: Real[Tensor, " vehicle"]
    belief: Belief

    def overview(self) -> Card:
        """Its bounds, its rows and the belief after it."""
        least, most = int(self.n.min()), int(self.n.max())
        rows = f"{most} rows" if least == most else f"{least} to {most} rows"
        below = self.belief.overview()
        title = f"Window {self.start_s:g} to {self.end_s:g} s, {rows}; {below.title[0].lower()}{below.title[1:]}"
        return Card(title, below.lines, below.table, below.most)


class BeliefStream:
    """Takes samples one by one or in blocks, on one clock for all vehicles; closes a window every ``window`` seconds.

    The result does not depend on how the samples are divided into blocks. Only the rows of the open window are kept.

    Args:
        window: length [s].
        form: which density; :class:`JerkForm` by default.
        gap: a step between rows longer than this [s] ends the window early; the next starts with the next row.
        check_units: refuse rows whose columns contradict each other in unit or sign
            (:mod:`avtorch.inference.stream_units`); false where units and signs are known to be right.
        estimator: a name of :data:`~avtorch.inference.estimators.ESTIMATORS`.
        device: where posteriors are computed and beliefs are; rows are collected, and checked, on the processor.
        **inference: the estimator's options, for ``"sgld"`` those of
            :class:`~avtorch.inference.sequential.SequentialInference` (``mode``, ``lam``, ``settings``, ``seed`` ...).

    Raises `InputError` for a ``window`` or ``gap`` that is not positive, an unknown estimator, an option it lacks, or a
    device that this machine lacks.

    Example:
        >>> from avtorch import BeliefStream, GLVDPlant, Leader, simulate
        >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> rows = {"accel": run.accel[:, 0], "accel_cmd": run.accel_cmd[:, 0], "jerk": run.jerk[:, 0]}
        >>> stream = BeliefStream(window=2.0, check_units=False, estimator="map")
        >>> windows = stream.feed(run.time, rows) + stream.flush()
        >>> [round(w.belief.stat("T_L")["mean"], 1) for w in windows]
        [0.5, 0.5]
    """

    def __init__(
        self,
        *,
        window: float = 2.0,
        form: Form | None = None,
        gap: float = 0.5,
        vehicles: int = 1,
        check_units: bool = True,
        estimator: str = "sgld",
        device: Device = "cpu",
        **inference: Any,
    ) -> None:
        if not window > 0:
            raise InputError(f"window: {window} s is not positive")
        if not gap > 0:
            raise InputError(f"gap: {gap} s is not positive")
        self.window, self.gap, self.vehicles = float(window), float(gap), vehicles
        self.form: Form = JerkForm() if form is None else form
        self.estimator, self.device = estimator, checked_device(device)
        self.inference = make_estimator(estimator, self.form, vehicles=vehicles, device=device, **inference)
        self._units = StreamUnits(self.form.columns, vehicles) if check_units else None
        self._rows: dict[str, Tensor] = self._empty()
        self._origin: float | None = None  # start of the first window since the last gap
        self._index = 0  # windows closed since then
        self._last: float | None = None  # time of the last row
        self._driven: list[float | None] = [None] * vehicles  # when a driver was last in charge
        self._epoch: float | None = None  # the first row's time; the others are counted from it

    @property
    def closes_at(self) -> float | None:
        """The end of the open window on the clock of the rows [s]; None where the next row begins one."""
        return None if self._origin is None else self._end() + (self._epoch or 0.0)

    def feed(
        self,
        time: Tensor,
        columns: Mapping[str, Tensor],
        *,
        usable: Tensor | None = None,
        engaged: Tensor | None = None,
        until: float | None = None,
    ) -> list[Window]:
        """Take in rows; return the windows they complete.

        Args:
            time: ``(time,)`` [s], increasing, after every row fed before.
            columns: the form's columns, each ``(vehicle, time)`` or ``(time,)``; others are left out.
            usable: ``(vehicle, time)`` bool; false masks a row (standstill).
            engaged: ``(vehicle, time)`` bool, or 0 and 1; false masks a row in which a driver is in charge, and those
                of the :data:`~avtorch.io.engagement.SETTLE_S` after it, in which the car's state is not known.
            until: the clock, if it is known to be ahead of the last row: a window that ends by then is closed.

        Raises `InputError` for time that does not increase, a column that is missing or of another shape, a usable row
        that is not finite, or ``engaged`` other than 0 and 1. The block is then rejected as a whole. Also where the
        last 10 to 40 s prove that a column has another unit or sign: the belief then also returns to its value before
        them.
        """
        time = torch.atleast_1d(torch.as_tensor(time, dtype=torch.float64)).cpu()
        epoch = self._epoch
        if epoch is None and time.ndim == 1 and len(time) and bool(time[0].isfinite()):
            epoch = float(time[0])
        usable, driven = self._since_driven(self._since(time, epoch), usable, engaged)
        block = self._checked(time, columns, usable)
        time = block["time"] = self._since(time, epoch)
        before = torch.empty(0) if self._last is None else torch.tensor([self._last], dtype=torch.float64)
        steps = torch.cat([before, time]).diff()
        if bool((steps <= 0).any()):
            late = int((steps <= 0).nonzero()[0, 0]) + len(time) - len(steps)
            raise InputError(f"time: does not increase at {_moment(float(time[late]), epoch)}")
        if len(time) and self._origin is not None and float(time[0]) < self._end() - self.window - ROUNDING_S:
            at = _moment(float(time[0]), epoch)
            raise InputError(f"time: a row at {at}, but the window it belongs to is closed already")
        with self._whole_or_nothing():
            self._driven, self._epoch = driven, epoch
            return self._take(block, steps, until)

    def _take(self, block: dict[str, Tensor], steps: Tensor, until: float | None) -> list[Window]:
        """Process ordered rows, split where ``steps`` between them are gaps."""
        time = block["time"]
        windows: list[Window] = []
        pieces = [*((steps > self.gap).nonzero().squeeze(-1) + (len(time) - len(steps))).tolist(), len(time)]
        first = 0
        for last in pieces:
            if last > first:
                windows += self._append({name: value[..., first:last] for name, value in block.items()})
            if last < len(time):
                windows += self._flush()
            first = last
        if until is None or self._epoch is None:
            return windows
        clock = self._since(torch.tensor([until], dtype=torch.float64), self._epoch)
        return windows + self._close_until(float(clock[0]))

    @contextmanager
    def _whole_or_nothing(self) -> Iterator[None]:
        """Where rows prove a unit wrong, restore the stream before them and the belief before their stretch."""
        before = self._place()
        try:
            yield
        except InputError:
            self._return_to(before)
            if self._units is not None and self._units.before is not None:
                self.inference.load_state_dict(self._units.before)
                self._units.clear()
            raise

    def flush(self) -> list[Window]:
        """Close the open window early, if it has any rows, and start afresh with the next row.

        Raises `InputError` as :meth:`feed` for units and signs.
        """
        with self._whole_or_nothing():
            return self._flush()

    def _flush(self) -> list[Window]:
        windows = [self._close(early=True)] if len(self._rows["time"]) else []
        self._origin, self._index = None, 0
        return windows

    def _since_driven(
        self, time: Tensor, usable: Tensor | None, engaged: Tensor | None
    ) -> tuple[Tensor | None, list[float | None]]:
        """The rows of ``usable`` that remain, and when a driver was last in charge of each vehicle."""
        if engaged is None and not any(x is not None for x in self._driven):
            return usable, self._driven
        if time.ndim != 1:
            return usable, self._driven  # which is refused in a moment
        shape = (self.vehicles, len(time))
        own = torch.ones(shape) if engaged is None else torch.atleast_2d(torch.as_tensor(engaged)).cpu()
        if own.shape not in (shape, (1, shape[1])):
            raise InputError(f"engaged: of shape {tuple(own.shape)}, needs {shape} (vehicle, time) or ({shape[1]},)")
        on = own.bool().expand(shape)
        odd = (own != 0) & (own != 1)
        if bool(odd.any()):
            raise InputError(f"engaged: found {float(own[odd][0]):g}, needs 0 (driver) or 1 (engaged)")
        before = np.array([-np.inf if x is None else x for x in self._driven])
        rests, last = settled_rows(time.numpy(), on.numpy(), before)
        counts = on & torch.from_numpy(rests)
        driven = [float(x) if np.isfinite(x) else None for x in last]
        return counts if usable is None else counts & torch.as_tensor(usable, dtype=torch.bool).cpu(), driven

    def _checked(self, time: Tensor, columns: Mapping[str, Tensor], usable: Tensor | None) -> dict[str, Tensor]:
        """The block as ``(time,)`` times and ``(vehicle, time)`` columns, or an InputError."""
        time = torch.atleast_1d(torch.as_tensor(time, dtype=torch.float64))
        if time.ndim != 1 or not bool(time.isfinite().all()):
            raise InputError(f"time: of shape {tuple(time.shape)}, needs finite numbers of shape (time,)")
        mask = (
            torch.ones(len(time), dtype=torch.bool)
            if usable is None
            else torch.as_tensor(usable, dtype=torch.bool).cpu()
        )
        given = {"usable": mask}
        for name in self.form.columns:
            if name not in columns:
                raise InputError(f"columns: {name} is missing; this form needs {', '.join(self.form.columns)}")
            given[name] = torch.as_tensor(columns[name], dtype=torch.float64).cpu()
        block = {"time": time}
        shape = (self.vehicles, len(time))
        for name, value in given.items():
            if torch.atleast_2d(value).shape not in (shape, (1, len(time))):
                raise InputError(
                    f"{name}: of shape {tuple(value.shape)}, needs {shape} (vehicle, time) or ({shape[1]},)"
                )
            block[name] = torch.atleast_2d(value).expand(shape)
            # a masked row may hold any number
            bad = block["usable"] & ~block[name].isfinite()
            if bool(bad.any()):
                raise InputError(
                    f"{name}: not finite at {float(time[bad.any(0)][0]):.15g} s, in a row that is not masked"
                )
        return block

    def _append(self, block: dict[str, Tensor]) -> list[Window]:
        """Rows without a gap; window by window, so that no more than one window of them is ever kept."""
        time = block["time"]
        if self._origin is None:
            self._origin = float(time[0])
        windows: list[Window] = []
        first = 0
        while first < len(time):
            # with the first row of the next window this one is known to be complete
            last = min(int((time < self._end() - ROUNDING_S).sum()) + 1, len(time))
            self._rows = {name: torch.cat([self._rows[name], block[name][..., first:last]], -1) for name in block}
            self._last = float(time[last - 1])
            windows += self._close_until(self._last)
            first = last
        return windows

    def _close_until(self, clock: float) -> list[Window]:
        windows = []
        # round-off in a clock that counts 0.01 s must not push a row over a window's end
        while self._origin is not None and clock >= self._end() - ROUNDING_S:
            windows.append(self._close())
        return windows

    def _end(self) -> float:
        assert self._origin is not None
        return self._origin + (self._index + 1) * self.window

    def _close(self, *, early: bool = False) -> Window:
        start, end = self._end() - self.window, self._end()
        count = int((self._rows["time"] < end - ROUNDING_S).sum())
        rows = {name: value[..., :count] for name, value in self._rows.items()}
        self._rows = {name: value[..., count:].clone() for name, value in self._rows.items()}
        steps = rows["time"].diff()
        full = self.window / float(steps.median()) if len(steps) else torch.inf
        if early:
            # time beyond the last row's own step belongs to no window
            end = min(end, float(rows["time"][-1]) + (self.window / full))
        if self._units is not None:
            self._units.take(rows, self.inference.state_dict())
        there = {name: value.to(self.device) for name, value in rows.items()}
        likelihood = self.form.likelihood(there, full)
        belief = self.inference.take(there, likelihood)
        self._index += 1
        clock = 0.0 if self._epoch is None else self._epoch
        return Window(start + clock, end + clock, likelihood.n, belief)

    @staticmethod
    def _since(time: Tensor, epoch: float | None) -> Tensor:
        """Seconds from `epoch`, independent of the division into blocks: near 1.7e9 a float64 is 2.4e-7 s off."""
        if epoch is None:
            return time
        return torch.from_numpy(np.round(time.numpy() - epoch, decimals(abs(epoch) + _LONGEST_S)))

    def _empty(self) -> dict[str, Tensor]:
        rows = {name: torch.empty(self.vehicles, 0, dtype=torch.float64) for name in self.form.columns}
        usable = torch.empty(self.vehicles, 0, dtype=torch.bool)
        return {"time": torch.empty(0, dtype=torch.float64), "usable": usable, **rows}

    def state_dict(self) -> dict[str, Any]:
        """The open window's rows and the belief: all that a resumed stream needs to continue bit for bit."""
        units = None if self._units is None else self._units.state_dict()
        return {**self._place(), **self._own(), "units": units, "inference": self.inference.state_dict()}

    def _own(self) -> dict[str, Any]:
        """What a saved stream must have in common with this one."""
        form = type(self.form).__name__
        return {"estimator": self.estimator, "form": form, "window": self.window, "vehicles": self.vehicles}

    def _place(self) -> dict[str, Any]:
        """How far the rows came. Its values are replaced, never changed."""
        return {name: getattr(self, f"_{name}") for name in _PLACE}

    def _return_to(self, place: Mapping[str, Any]) -> None:
        for name in _PLACE:
            setattr(self, f"_{name}", place[name])

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`. Where it is refused, the stream is unchanged.

        Raises `InputError` if it was saved by a stream of another window length, form, estimator or number of vehicles.
        """
        if not isinstance(state, dict):
            raise InputError(f"state: found a {type(state).__name__}, needs what a stream saves")
        for name, value in self._own().items():
            if type(state.get(name)) is not type(value) or state[name] != value:
                setting = "by the estimator" if name == "estimator" else f"with {name}"
                raise InputError(f"state: saved {setting} {str(state.get(name))[:40]!r}, not {value!r}")
        if set(state) != {*_PLACE, *self._own(), "units", "inference"}:
            raise InputError(f"state: holds {', '.join(sorted(map(str, state)))[:200]}, not what a stream saves")
        stretch = StreamUnits(self.form.columns, self.vehicles)
        if state["units"] is not None:
            stretch.load_state_dict(state["units"])
        present = self.inference.state_dict()
        try:
            if stretch.before is not None:  # only to check that it could be restored
                self.inference.load_state_dict(stretch.before)
            self.inference.load_state_dict(state["inference"])
        except InputError:
            self.inference.load_state_dict(present)
            raise
        if self._units is not None:
            self._units = stretch
        self._return_to(state)


def _moment(time: float, epoch: float | None) -> str:
    """A row's time [s] for messages: from the first row on, unless the clock itself counts from there."""
    return f"{time:g} s" if not epoch else f"{time:g} s from the first row ({epoch + time:.15g} s)"
