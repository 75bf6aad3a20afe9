"""A recorded log, window by window: belief, alerts and P(string stable) (the command line's `estimate`).

An interrupted `estimate` continues from a file of finished windows (`KeptWindows`).

Each window's posterior is the prior of the next, so the file holds the whole state behind the last row taken in: the
belief with its draws, the state of the random numbers, the open window's rows and the monitor's baseline. With it the
windows that follow are those of an uninterrupted run, to the bit. Of the windows before it only what an answer holds is
kept, without their draws. The file states what it belongs to.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from avtorch.decision.dead_time import InferredDeadTime, infer_dead_time
from avtorch.decision.monitor import Monitor, MonitorReport
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch, WatchedWindow, window_frame
from avtorch.display import Card, Displayed, Frame
from avtorch.display.progress import called, shows_progress
from avtorch.errors import InputError
from avtorch.inference.belief import Belief
from avtorch.inference.form import Form
from avtorch.inference.jerk import JerkForm
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream import BeliefStream, Window, packed, unpacked
from avtorch.io import fingerprint, read_sealed_bytes, write_sealed
from avtorch.io.log import Log, LogSource, as_log, no_command
from avtorch.io.mapping import Pairs
from avtorch.io.quality import Quality, check, require_usable
from avtorch.logcheck.late_channel import LateChannel, late_channel, on_time
from avtorch.version import __version__

if TYPE_CHECKING:
    import pandas
    from arviz import InferenceData

Array = NDArray[Any]
FormName = Literal["auto", "jerk", "latent"]

LEAST_ROWS = 10
"""Rows a window must span: fewer do not determine three parameters and their noise."""


@dataclass(frozen=True, repr=False)
class Estimates(Displayed):
    """The result of `estimate`.

    `windows` in the order of the log; `seconds_per_window` of computing; `form` "jerk" or "latent"; `quality` of the
    log, checked first; `setting` for which P(string stable) was computed, since a log does not contain its controller;
    `estimator` by name; `accepted` (T_L [s], K_L [-]) of a sound car, with which `accepted_change` compares;
    `dead_time` [s] that commands were given, and what it was `inferred` from the log to be, where it was; `late`: the
    channel that was late and put on time.

    Example:
        >>> from avtorch import GLVDPlant, Leader, estimate, simulate
        >>> run = simulate(Leader.default(start=50.0, duration=4.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> estimates = estimate(run.log(), estimator="map")
        >>> len(estimates.windows), estimates.form, estimates.excited_share
        (2, 'jerk', 1.0)
        >>> [f"{row['parameter']} {row['mean']:.1f} {row['unit']}" for row in estimates.summary().rows()][:2]
        ['T_L 0.5 s', 'K_L 0.9 -']
    """

    windows: list[WatchedWindow]
    seconds_per_window: float
    form: str
    quality: Quality
    setting: Setting
    estimator: str = "sgld"
    accepted: tuple[float, float] = (0.3, 1.0)
    dead_time: float = 0.0
    inferred: InferredDeadTime | None = None
    late: LateChannel | None = None

    def overview(self) -> Card:
        """How many windows were used, by what, and the belief after the last."""
        first, last = self.windows[0].window, self.windows[-1].window
        title = f"Estimates in {len(self.windows)} windows from {first.start_s:g} to {last.end_s:g} s"
        lines = [
            f"{self.form} form by {self.estimator}; {100 * self.excited_share:.0f} % of the windows excited; dead time "
            f"{self.dead_time:g} s{' (inferred)' if self.inferred is not None else ''}."
        ]
        if self.late is not None:
            lines.append(str(self.late))
        alarmed = [w for w in self.windows if w.report.names()]
        count = f"{len(alarmed)} window{'' if len(alarmed) == 1 else 's'}"
        lines.append(f"Alerts in {count}. The belief after the last window:")
        return Card(title, tuple(lines), self.summary(), most=9)

    def summary(self) -> Frame:
        """The belief after the last window, which carries all before it: mean, sd, the 5 and 95 % quantiles."""
        whole = self.windows[-1].window.belief.summary().columns
        return Frame({name: values for name, values in whole.items() if name not in ("vehicle", "used")})

    def to_dataframe(self) -> pandas.DataFrame:
        """A row a window: bounds [s], rows, figures of each parameter, P(string stable), alerts.

        Needs ``pip install 'avtorch[pandas]'``.
        """
        columns = window_frame(self.windows).columns
        return Frame({name: values for name, values in columns.items() if name != "scenario"}).to_dataframe()

    def to_arviz(self, *, window: int = -1) -> InferenceData:
        """The draws after a `window`, the last by default, as one chain. Needs ``pip install 'avtorch[arviz]'``.

        Raises `InputError` for a window that is not there, and for one that comes without draws from a checkpoint.
        """
        if not -len(self.windows) <= window < len(self.windows):
            raise InputError(f"window: found {window}, needs a number below {len(self.windows)}")
        return self.windows[window].window.belief.to_arviz()

    @property
    def excited_share(self) -> float:
        """Share of the windows that were excited and therefore used."""
        excited = [bool(w.window.belief.excited[0]) for w in self.windows]
        return sum(excited) / len(excited)

    def spread_ratio(self, name: str) -> float | None:
        """Spread of a parameter from window to window over its posterior SD, None below three used windows.

        About 1 where the vehicle does not change and the posterior has the right width; above 1.5 the posterior is too
        narrow for this log, or the vehicle changed. Each window's distance from the mean is divided by its own SD, and
        the mean weighs windows by precision (the Birge ratio), so uninformative windows do not count as spread.
        """
        beliefs = [w.window.belief for w in self.windows]
        stats = [b.stat(name) for b in beliefs if bool(b.excited[0] & b.converged[0])]
        if len(stats) < 3:
            return None
        centre = fmean([s["mean"] for s in stats], weights=[s["sd"] ** -2 for s in stats])
        return math.sqrt(sum(((s["mean"] - centre) / s["sd"]) ** 2 for s in stats) / (len(stats) - 1))


@shows_progress
def estimate(
    log: LogSource,
    window: float = 2.0,
    *,
    map: Pairs = None,
    unit: Pairs = None,
    form: FormName = "auto",
    estimator: str = "auto",
    setting: Setting | None = None,
    monitor: Monitor | None = None,
    accepted: tuple[float, float] = (0.3, 1.0),
    dead_time: float | None = 0.0,
    align: bool = True,
    progress: Callable[[int, int], None] | bool | None = None,
    finished: Callable[[WatchedWindow], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    seed: int = 0,
    **inference: Any,
) -> Estimates:
    """The belief in (T_L, K_L) over a log, one posterior per `window` [s], each the prior of the next.

    `log`: a `Log`, a path or a data frame; `map`, `unit`: names and units of the columns of what is read here, as
    `Log.read` takes them.

    `form`: "jerk" needs measured jerk and accel (Eq. 4); "latent" takes accel and/or speed with their noise;
    "auto" is "jerk" where the log has both. Windows lie on a grid that starts afresh with each segment of the log; the
    last of a segment may be short. Rows at standstill, with `engaged` 0 and in the 2 s after a return to `engaged` are
    masked; nothing is filtered through them. `progress(done, of)` is called with rows (True is a bar, False
    none, and None a bar in a notebook only), `finished` with each window as it is done.

    `checkpoint`, with the default monitor only: a file that an interrupted call leaves, and from which one with the
    same log and options continues, to the same result to the bit; windows finished before the interruption come without
    their draws. It is removed at the end.

    `estimator`: "sgld" samples each window's posterior by Langevin dynamics, "importance" by weighted draws; "auto" is
    "sgld" for the jerk form and "importance" for the latent one, whose gradients are dear. "map" takes the mode and its
    curvature, "rls" is recursive least squares (measured jerk only), "ekf" and "ukf" are joint Kalman filters. Further
    keywords are the estimator's own (`mode`, `lam`, `settings`, ...; see
    `avtorch.inference.estimators.make_estimator`).

    `dead_time` [s] of the vehicle, where it is known; None infers it first in the latent form
    (`avtorch.decision.dead_time`) and takes none in the jerk form. Commands act that much later, and the first rows of
    a drive, whose commands are not in the log or were not obeyed, are masked. The default monitor computes its verdicts
    with it, and compares with `accepted` (T_L [s], K_L [-]).

    `align`, in the latent form: where accel comes clearly later than the slope of speed or before it, the late channel
    is moved; one behind a long filter is left out (`avtorch.logcheck.late_channel`).

    Raises `InputError` for a log without accel_cmd or without any row that counts, a form whose columns it lacks, a
    window longer than the log, or an estimator that is not known or cannot take the form;
    and for a `checkpoint` that is damaged, belongs to other work or cannot be written.

    Example:
        >>> from avtorch import GLVDPlant, Leader, estimate, simulate
        >>> run = simulate(Leader.default(start=50.0, duration=2.0, dt=0.02), plant=GLVDPlant(0.5, 0.9))
        >>> window = estimate(run.log(), window=2.0).windows[0].window
        >>> [round(window.belief.stat(name)["mean"], 1) for name in ("T_L", "K_L")]
        [0.5, 0.9]
    """
    step = called(progress)
    log = as_log(log, map=map, unit=unit)
    if log.accel_cmd is None:
        raise no_command(log, "; T_L and K_L need the demanded acceleration")
    require_usable(log)
    chosen = _form(log, form)
    if not window > 0:
        raise InputError(f"window: found {window:g} s, needs a number above 0")
    if window * log.rate_hz < LEAST_ROWS:
        least = LEAST_ROWS / log.rate_hz
        raise InputError(f"window: found {window:g} s, needs {least:g} s or more, {LEAST_ROWS} rows of {log.name}")
    longest = max(float(log.elapsed[part][-1] - log.elapsed[part][0]) for part in log.segments())
    # a window of rows spans one step less than its length
    if window > longest + 1.5 / log.rate_hz:
        raise InputError(f"window: found {window:g} s, needs at most {longest:g} s, the longest segment of {log.name}")
    if dead_time is not None and not (math.isfinite(dead_time) and 0.0 <= dead_time < window):
        raise InputError(f"dead_time: found {dead_time:g} s, needs 0 or more and less than the window, {window:g} s")
    quality = check(log)
    begun = time.perf_counter()
    late, have = None, np.ones(log.rows, bool)
    if align and isinstance(chosen, LatentForm) and (late := late_channel(log)) is not None:
        log, have = on_time(log, late)
        chosen = _form(log, "latent")
    inferred = None
    if dead_time is None:
        inferred = infer_dead_time(log, partial(_delayed, log)) if isinstance(chosen, LatentForm) else None
        dead_time = 0.0 if inferred is None or inferred.seconds >= window else inferred.seconds
    if estimator == "auto":
        estimator = "importance" if isinstance(chosen, LatentForm) else "sgld"
    if checkpoint is not None and monitor is not None:
        raise InputError("checkpoint: found with a monitor, whose thresholds it does not name; needs one of the two")
    monitor = Monitor(accepted=accepted, dead_time=dead_time) if monitor is None else monitor
    setting = Setting() if setting is None else setting
    if setting.shape != (1,):
        raise InputError(f"setting: found shape {tuple(setting.shape)}, needs one, (1,), for one log")
    # the log's units were checked as a whole when it was read
    options = {"estimator": estimator, "seed": seed, "check_units": False, **inference}
    watch = Watch(BeliefStream(window=window, form=chosen, gap=float("inf"), **options), monitor)
    command, known = _delayed(log, dead_time)
    usable = torch.from_numpy(log.usable & known & have)
    signals = {name: torch.from_numpy(getattr(log, name)) for name in chosen.columns}
    signals["accel_cmd"] = torch.from_numpy(command)
    name = "jerk" if isinstance(chosen, JerkForm) else "latent"
    work: dict[str, str] = {}
    if checkpoint is not None:
        settings = (window, name, dead_time, estimator, seed, accepted, align, inference)
        work = estimated_work(log, settings, watch.state_dict(), setting)
    kept = KeptWindows(checkpoint, work)
    windows, begin = kept.restored(watch, setting)
    tell = (lambda _: None) if finished is None else finished
    for w in windows:
        tell(w)
    try:
        for place, seen in _fed(log, watch, setting, window, signals, usable, begin):
            kept.keep(watch, seen, place)
            windows += seen
            for w in seen:
                tell(w)
            if step is not None:
                step(place.row, log.rows)
    except BaseException:
        with suppress(InputError):  # report the first failure
            kept.write()
        raise
    kept.remove()
    seconds = (time.perf_counter() - begun) / max(len(windows), 1)
    T, K = (float(x[0]) for x in watch.monitor.accepted)
    return Estimates(windows, seconds, name, quality, setting, estimator, (T, K), dead_time, inferred, late)


def _fed(
    log: Log,
    watch: Watch,
    setting: Setting,
    window: float,
    signals: dict[str, Tensor],
    usable: Tensor,
    place: Place,
) -> Iterator[tuple[Place, list[WatchedWindow]]]:
    """Feeds the log from `place` on, about a window at a time, so that progress can be reported and an interruption
    handled; yields how far it came and the windows that were finished."""
    row, last, ahead = place.row, place.last, place.ahead
    many = min(1000, max(LEAST_ROWS, int(window * log.rate_hz)))
    for part in log.segments():
        if part.stop <= row:
            continue
        own = torch.from_numpy(log.elapsed[part])
        # a segment's clock may start anew, the stream's must go on
        if row <= part.start and float(own[0]) + ahead <= last:
            ahead = last + window - float(own[0])
        time = own + ahead
        last = float(time[-1])
        later = ahead + float(log.elapsed[part.start] - log.time[part.start])
        for first in range(max(row - part.start, 0), len(time), many):
            block = slice(first, first + many)
            rows = {name: signal[part][block] for name, signal in signals.items()}
            seen = watch.feed(time[block], rows, setting, usable=usable[part][block])
            if first + many >= len(time):
                seen += watch.flush(setting)
            place = Place(part.start + min(first + many, len(time)), last, ahead)
            yield place, [_on_the_logs_clock(w, later) for w in seen]


def _delayed(log: Log, dead_time: float) -> tuple[Array, Array]:
    """The command that acts in each row's interval, (time,) [m/s²], and whether the log holds it and it was obeyed.

    A command is held from its row to the next; where the switch falls inside an interval, its mean acts.
    """
    command = np.asarray(log.accel_cmd, np.float64)
    known = np.ones(log.rows, dtype=bool)
    if dead_time == 0.0:
        return command, known
    out = command.copy()
    for part in log.engaged_segments():
        time, u = log.elapsed[part], command[part]
        step = np.diff(time, append=2 * time[-1] - time[-2] if len(time) > 1 else time[-1] + 1.0)
        edges = np.append(time, time[-1] + step[-1])
        sent = np.concatenate([[0.0], np.cumsum(u * step)])
        begin, end = time - dead_time, edges[1:] - dead_time
        # before the first row the first command is taken to have acted, and the rows are masked
        held = [np.where(t < time[0], u[0] * (t - time[0]), np.interp(t, edges, sent)) for t in (begin, end)]
        out[part] = (held[1] - held[0]) / step
        known[part] = begin >= time[0] - 1e-9
    return out, known


def _on_the_logs_clock(watched: WatchedWindow, ahead: float) -> WatchedWindow:
    if ahead == 0.0:
        return watched
    # rounded to a nanosecond: finer than any clock resolves, coarser than the round-off of both conversions
    start, end = (round(t - ahead, 9) for t in (watched.window.start_s, watched.window.end_s))
    return replace(watched, window=replace(watched.window, start_s=start, end_s=end))


def _form(log: Log, form: FormName) -> Form:
    if form not in ("auto", "jerk", "latent"):
        raise InputError(f"form: found {form!r}, needs 'auto', 'jerk' or 'latent'")
    measured = log.jerk is not None and log.accel is not None
    if form == "jerk" and not measured:
        raise InputError(f"form: 'jerk' needs the columns jerk and accel, which {log.name} lacks; try 'latent'")
    if form != "latent" and measured:
        return JerkForm()
    return LatentForm(accel=log.accel is not None, speed=log.speed is not None)


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
    def numbers(x: Any) -> Tensor:
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
