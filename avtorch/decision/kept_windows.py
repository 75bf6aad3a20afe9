"""A file of finished windows, from which an interrupted `estimate` continues.

Each window's posterior is the prior of the next, so the file holds the whole state behind the last row taken in: the
belief with its draws, the state of the random numbers, the open window's rows and the monitor's baseline. With it the
windows that follow are those of an uninterrupted run, to the bit. Of the windows before it only what an answer holds is
kept, without their draws. The file states what it belongs to.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from avtorch.decision.monitor import MonitorReport
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch, WatchedWindow
from avtorch.errors import InputError
from avtorch.inference.belief import Belief
from avtorch.inference.stream import Window, packed, unpacked
from avtorch.io import fingerprint, read_sealed_bytes, write_sealed
from avtorch.io.log import Log
from avtorch.version import __version__

SCHEMA = "avtorch.windows/1"
MOST = 2**28
"""Limit on the bytes of a file: a window takes a kilobyte, the state a tenth of a megabyte."""
EVERY_S = 2.0
"""Wall-clock time between two writings [s]: what is computed again at most after a kill. An interrupted run writes once
more, and one that takes less and is not interrupted writes nothing."""

REMEDY = "remove it to begin anew (avtorch estimate --no-resume), or use another folder"

_SIGNALS = ("time", "accel_cmd", "accel", "speed", "jerk", "usable", "segment")
_STATS = ("mean", "sd", "q05", "q95")


@dataclass(frozen=True)
class Place:
    """How far a log was taken in: the next `row`, the time of the last one fed [s], how far the stream's clock is
    `ahead` of the segment's [s]."""

    row: int = 0
    last: float = -torch.inf
    ahead: float = 0.0


def estimated_work(log: Log, *settings: Any) -> dict[str, str]:
    """What finished windows belong to, by fingerprint."""
    content = fingerprint([getattr(log, name) for name in _SIGNALS])
    return {"avtorch": __version__, "log": content, "settings": fingerprint(settings)}


class KeptWindows:
    """The windows of one run of `estimate` at `path`; with None nothing is kept.

    `work`: what they belong to, from `estimated_work`. Raises `InputError` for a file that is damaged or belongs to
    other work.
    """

    def __init__(self, path: str | os.PathLike[str] | None, work: Mapping[str, str]) -> None:
        self.path, self.work = None if path is None else Path(path), dict(work)
        self._written = time.monotonic()
        self._state: dict[str, Any] | None = None
        self._windows: list[dict[str, Any]] = []

    def restored(self, watch: Watch, setting: Setting) -> tuple[list[WatchedWindow], Place]:
        """The windows kept by an earlier run, and how far it came, after which `watch` is brought to its state."""
        if self.path is None or not os.path.lexists(self.path):
            return [], Place()
        found = read_sealed_bytes(self.path, schema=SCHEMA, most=MOST, remedy=REMEDY)
        if other := [name for name, value in self.work.items() if found.of.get(name) != value]:
            differs = f"was begun with different {' and '.join(other)}"
            raise InputError(f"{self.path}: {differs}; needs the same log and settings, or {REMEDY}")
        state = unpacked(found.content, self.path, REMEDY)
        try:
            watch.load_state_dict(state["watch"])
            self._windows, place = state["windows"], Place(**state["place"])
            return [_window(entry, setting) for entry in self._windows], place
        except (KeyError, TypeError, ValueError, InputError) as fault:
            raise InputError(f"{self.path}: holds no windows of an estimate ({fault}); {REMEDY}") from None

    def keep(self, watch: Watch, new: Sequence[WatchedWindow], place: Place) -> None:
        """Take in the windows that were finished since the last call; they are written now and then."""
        if self.path is None:
            return
        self._windows += [_entry(window) for window in new]
        self._state = {"watch": watch.state_dict(), "place": vars(place)}
        if time.monotonic() - self._written >= EVERY_S:
            self.write()

    def write(self) -> None:
        """Write what was kept. Raises `InputError` where that cannot be done."""
        if self.path is not None and self._state is not None and self._windows:
            content = packed({**self._state, "windows": self._windows})
            write_sealed(self.path, content, schema=SCHEMA, of=self.work)
        self._written = time.monotonic()

    def remove(self) -> None:
        """Remove the file: the answer takes its place."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _entry(watched: WatchedWindow) -> dict[str, Any]:
    window, belief, report = watched.window, watched.window.belief, watched.report
    tensors = {name: getattr(belief, name) for name in (*_STATS, "excited", "converged")}
    tensors |= {name: getattr(report, name) for name in ("p_string_stable", "p_local_stable")}
    tensors |= {"n": window.n, "report_mean": torch.stack(report.mean), "accepted": torch.stack(report.accepted)}
    named = {"alerts": report.alerts, "statistics": report.statistics}
    return {
        "start_s": window.start_s,
        "end_s": window.end_s,
        "names": list(belief.names),
        **{name: x.tolist() for name, x in tensors.items()},
        **{name: {key: x.tolist() for key, x in one.items()} for name, one in named.items()},
    }


def _window(entry: Mapping[str, Any], setting: Setting) -> WatchedWindow:
    def numbers(x: Any) -> torch.Tensor:
        return torch.tensor(x, dtype=torch.float64)

    mean, sd, q05, q95 = (numbers(entry[name]) for name in _STATS)
    excited, converged = (torch.tensor(entry[name], dtype=torch.bool) for name in ("excited", "converged"))
    belief = Belief(tuple(entry["names"]), mean, sd, q05, q95, mean[None][:0], excited, converged)
    report = MonitorReport(
        {name: torch.tensor(x, dtype=torch.bool) for name, x in entry["alerts"].items()},
        {name: numbers(x) for name, x in entry["statistics"].items()},
        numbers(entry["p_string_stable"]),
        numbers(entry["p_local_stable"]),
        (numbers(entry["report_mean"][0]), numbers(entry["report_mean"][1])),
        (numbers(entry["accepted"][0]), numbers(entry["accepted"][1])),
    )
    return WatchedWindow(Window(entry["start_s"], entry["end_s"], numbers(entry["n"]), belief), report, setting)
