"""Samples in, one posterior per window out: the online form of the sequential loop, with a bounded memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

import torch
from torch import Tensor

from avtorch.errors import InputError
from avtorch.inference.belief import Belief
from avtorch.inference.estimators.choose import make_estimator
from avtorch.inference.evidence import Form, JerkForm


@dataclass(frozen=True)
class Window:
    """One window of every vehicle, and what is believed after it.

    Attributes:
        start_s, end_s: its bounds on the log's own clock [s]; a row belongs to it if ``start_s <= time < end_s``.
        n: usable rows, ``(vehicle,)``.
        belief: see :class:`Belief`; the window was used where ``belief.excited`` and
            ``belief.converged`` hold.
    """

    start_s: float
    end_s: float
    n: Tensor
    belief: Belief


class BeliefStream:
    """Takes samples one by one or in blocks, at one clock for all vehicles; closes a window every ``window`` seconds.

    How the samples are cut into blocks changes nothing. Only the rows of the open window are kept.

    Args:
        window: length [s].
        form: which density; :class:`JerkForm` by default.
        gap: a step between rows longer than this [s] ends the window early; the next starts with the next row.
        estimator: a name of :data:`~avtorch.inference.estimators.ESTIMATORS`.
        **inference: the estimator's options, for ``"sgld"`` those of
            :class:`~avtorch.inference.sequential.SequentialInference` (``mode``, ``lam``, ``settings``, ``seed`` ...).

    Raises:
        InputError: for a ``window`` or ``gap`` that is not positive, an unknown estimator or an option it lacks.
    """

    def __init__(
        self,
        *,
        window: float = 2.0,
        form: Form | None = None,
        gap: float = 0.5,
        vehicles: int = 1,
        estimator: str = "sgld",
        **inference: Any,
    ) -> None:
        if not window > 0:
            raise InputError(f"window: {window} s is not positive")
        if not gap > 0:
            raise InputError(f"gap: {gap} s is not positive")
        self.window, self.gap, self.vehicles = float(window), float(gap), vehicles
        self.form: Form = JerkForm() if form is None else form
        self.estimator = estimator
        self.inference = make_estimator(estimator, self.form, vehicles=vehicles, **inference)
        self._rows: dict[str, Tensor] = self._empty()
        self._origin: float | None = None  # start of the first window since the last gap
        self._index = 0  # windows closed since then
        self._last: float | None = None  # time of the last row

    def feed(
        self, time: Tensor, columns: Mapping[str, Tensor], *, usable: Tensor | None = None, until: float | None = None
    ) -> list[Window]:
        """Take in rows; return the windows they complete.

        Args:
            time: ``(time,)`` [s], increasing, after every row fed before.
            columns: the form's columns, each ``(vehicle, time)`` or ``(time,)``; others are left out.
            usable: ``(vehicle, time)`` bool; false masks a row (a driver overrides, standstill).
            until: the clock, if it is known to be ahead of the last row: a window that ends by then is closed.

        Raises:
            InputError: for time that does not increase, a column that is missing or of another shape, or a usable row
                that is not finite. Nothing of the block is then taken in.
        """
        block = self._checked(time, columns, usable)
        time = block["time"]
        before = torch.empty(0) if self._last is None else torch.tensor([self._last], dtype=torch.float64)
        steps = torch.cat([before, time]).diff()
        if bool((steps <= 0).any()):
            late = int((steps <= 0).nonzero()[0, 0]) + len(time) - len(steps)
            raise InputError(f"time: does not increase at {float(time[late]):g} s")
        if len(time) and self._origin is not None and float(time[0]) < self._end() - self.window - 1e-6:
            raise InputError(f"time: a row at {float(time[0]):g} s, but the window it belongs to is closed already")
        windows: list[Window] = []
        pieces = [*((steps > self.gap).nonzero().squeeze(-1) + (len(time) - len(steps))).tolist(), len(time)]
        first = 0
        for last in pieces:
            if last > first:
                windows += self._append({name: value[..., first:last] for name, value in block.items()})
            if last < len(time):
                windows += self.flush()
            first = last
        return windows + (self._close_until(until) if until is not None else [])

    def flush(self) -> list[Window]:
        """Close the open window early, if it has any rows, and start afresh with the next row."""
        windows = [self._close(early=True)] if len(self._rows["time"]) else []
        self._origin, self._index = None, 0
        return windows

    def _checked(self, time: Tensor, columns: Mapping[str, Tensor], usable: Tensor | None) -> dict[str, Tensor]:
        """The block as ``(time,)`` times and ``(vehicle, time)`` columns, or an InputError."""
        time = torch.atleast_1d(torch.as_tensor(time, dtype=torch.float64))
        if time.ndim != 1 or not bool(time.isfinite().all()):
            raise InputError(f"time: of shape {tuple(time.shape)}, needs finite numbers of shape (time,)")
        mask = torch.ones(len(time), dtype=torch.bool) if usable is None else torch.as_tensor(usable, dtype=torch.bool)
        given = {"usable": mask}
        for name in self.form.columns:
            if name not in columns:
                raise InputError(f"columns: {name} is missing; this form needs {', '.join(self.form.columns)}")
            given[name] = torch.as_tensor(columns[name], dtype=torch.float64)
        block = {"time": time}
        shape = (self.vehicles, len(time))
        for name, value in given.items():
            if torch.atleast_2d(value).shape not in (shape, (1, len(time))):
                raise InputError(
                    f"{name}: of shape {tuple(value.shape)}, needs {shape} (vehicle, time) or ({shape[1]},)"
                )
            block[name] = torch.atleast_2d(value).expand(shape)
            # a masked row may hold anything
            bad = block["usable"] & ~block[name].isfinite()
            if bool(bad.any()):
                raise InputError(f"{name}: not finite at {float(time[bad.any(0)][0]):g} s, in a row that is not masked")
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
            last = min(int((time < self._end() - 1e-6).sum()) + 1, len(time))
            self._rows = {name: torch.cat([self._rows[name], block[name][..., first:last]], -1) for name in block}
            self._last = float(time[last - 1])
            windows += self._close_until(self._last)
            first = last
        return windows

    def _close_until(self, clock: float) -> list[Window]:
        windows = []
        # round-off in a clock that counts 0.01 s must not push a row over a window's end
        while self._origin is not None and clock >= self._end() - 1e-6:
            windows.append(self._close())
        return windows

    def _end(self) -> float:
        assert self._origin is not None
        return self._origin + (self._index + 1) * self.window

    def _close(self, *, early: bool = False) -> Window:
        start, end = self._end() - self.window, self._end()
        count = int((self._rows["time"] < end - 1e-6).sum())
        rows = {name: value[..., :count] for name, value in self._rows.items()}
        self._rows = {name: value[..., count:].clone() for name, value in self._rows.items()}
        steps = rows["time"].diff()
        full = self.window / float(steps.median()) if len(steps) else torch.inf
        if early:
            # what lies behind the last row's own step belongs to no window
            end = min(end, float(rows["time"][-1]) + (self.window / full))
        evidence = self.form.evidence(rows, full)
        belief = self.inference.take(rows, evidence)
        self._index += 1
        return Window(start, end, evidence.n, belief)

    def _empty(self) -> dict[str, Tensor]:
        rows = {name: torch.empty(self.vehicles, 0, dtype=torch.float64) for name in self.form.columns}
        usable = torch.empty(self.vehicles, 0, dtype=torch.bool)
        return {"time": torch.empty(0, dtype=torch.float64), "usable": usable, **rows}

    def state_dict(self) -> dict[str, Any]:
        """The open window's rows and the belief: all that a resumed stream needs to go on equal to the bit."""
        clock = {"origin": self._origin, "index": self._index, "last": self._last, "window": self.window}
        own = {"estimator": self.estimator, "inference": self.inference.state_dict()}
        return {"rows": dict(self._rows), **clock, **own}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict`.

        Raises:
            InputError: if it was saved by a stream of another window length, form or estimator.
        """
        # states older than the choice of an estimator are SGLD's
        if state.get("estimator", "sgld") != self.estimator:
            raise InputError(f"state: saved by the estimator {state['estimator']!r}, not {self.estimator!r}")
        if state["window"] != self.window:
            raise InputError(f"state: saved with a window of {state['window']} s, not {self.window} s")
        if set(state["rows"]) != set(self._rows):
            raise InputError(f"state: saved with the columns {sorted(state['rows'])}, not {sorted(self._rows)}")
        self.inference.load_state_dict(state["inference"])
        self._rows = {name: value.clone() for name, value in state["rows"].items()}
        self._origin, self._index, self._last = state["origin"], state["index"], state["last"]

    def save(self, path: str | PathLike[str]) -> None:
        """Write :meth:`state_dict` to a file."""
        torch.save(self.state_dict(), path)

    def load(self, path: str | PathLike[str]) -> None:
        """Read what :meth:`save` wrote; only tensors and plain values are read, no code is run."""
        self.load_state_dict(torch.load(path, weights_only=True))
