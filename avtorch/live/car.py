"""One car of a live source, and what is assumed of all: rows put in order, its open window, its belief and monitor."""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from avtorch.decision.monitor import DEFAULT_DETECTORS, Monitor
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch, WatchedWindow
from avtorch.errors import InputError
from avtorch.inference.form import Form, JerkForm
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream import BeliefStream
from avtorch.io.clock import ROUNDING_S
from avtorch.io.log import STANDSTILL_MPS
from avtorch.live.source import Counts, Row
from avtorch.vehicle.controllers import NOMINAL_GAINS

FormName = Literal["auto", "jerk", "latent"]
MOST_ROWS = 20_000
"""Rows of one car in a window; more are refused, so that a sender gone mad fills no memory."""


@dataclass(frozen=True)
class LiveSettings:
    """Settings of a live watch, the same for all cars.

    `window` [s]; `form` "jerk" (measured jerk and accel), "latent", or "auto": "jerk" for a car whose first row has
    both; `estimator` and `mode` as in `estimate`, "auto" being "map" for the jerk form and "importance" for the latent
    one, whose modes are dear; `time_gap` [s] and `gains` (k_s [1/s²], k_v [1/s], k_a [-]) of the controller; `accepted`
    (T_L [s], K_L [-]) of a sound car; `detectors`; `lateness` [s] by which a row may come behind newer ones; `cars` at
    most; `check_units`: refuse columns that contradict each other; `seed`.

    Raises `InputError` for numbers out of range.
    """

    window: float = 2.0
    form: FormName = "auto"
    estimator: str = "auto"
    mode: str = "lambda"
    time_gap: float = 1.0
    gains: tuple[float, float, float] = NOMINAL_GAINS
    accepted: tuple[float, float] = (0.3, 1.0)
    detectors: tuple[str, ...] = DEFAULT_DETECTORS
    lateness: float = 0.05
    cars: int = 1000
    check_units: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.window) and self.window > 0):
            raise InputError(f"window: found {self.window:g} s, needs a finite number above 0")
        if not (math.isfinite(self.lateness) and 0 <= self.lateness <= 10 * self.window):
            raise InputError(f"lateness: found {self.lateness:g} s, needs 0 or more, and at most ten windows")
        if self.cars < 1:
            raise InputError(f"cars: found {self.cars}, needs 1 or more")
        if self.form not in ("auto", "jerk", "latent"):
            raise InputError(f"form: found {self.form!r}, needs 'auto', 'jerk' or 'latent'")
        self.setting()
        self.watch("", JerkForm() if self.form != "latent" else LatentForm(accel=True, speed=True))

    def setting(self) -> Setting:
        """The controller of a car."""
        return Setting(time_gap=self.time_gap, gains=self.gains, scenarios=1)

    def form_of(self, signals: set[str]) -> Form | None:
        """The form for a car with these signals; None where they do not suffice."""
        if "accel_cmd" not in signals:
            return None
        if self.form != "latent" and {"accel", "jerk"} <= signals:
            return JerkForm()
        if self.form == "jerk" or not signals & {"accel", "speed"}:
            return None
        return LatentForm(accel="accel" in signals, speed="speed" in signals)

    def watch(self, car: str, form: Form) -> Watch:
        """A new watch of one car. Its seed follows from the car's name, and so not from the order of cars."""
        digest = hashlib.sha256(f"{self.seed}/{car}".encode()).digest()
        options: dict[str, Any] = {"seed": int.from_bytes(digest[:6], "big"), "check_units": self.check_units}
        estimator = self.estimator
        if estimator == "auto":
            estimator = "map" if isinstance(form, JerkForm) else "importance"
        if estimator in ("sgld", "map", "importance"):
            options["mode"] = self.mode
        stream = BeliefStream(window=self.window, form=form, estimator=estimator, **options)
        return Watch(stream, Monitor(accepted=self.accepted, detectors=self.detectors))

    def to_dict(self) -> dict[str, str]:
        """By name, as text: what a state belongs to. The number of cars may change."""
        return {name: str(value) for name, value in asdict(self).items() if name != "cars"}


TimedRow = tuple[float, ...]
"""Time [s], then the values of the car's columns."""


def _time(row: TimedRow) -> float:
    return row[0]


class ReorderBuffer:
    """Rows that may still be overtaken; memory is bounded by `lateness` and `most`.

    `lateness`: how far behind the newest row a row may come and still count [s]. `most`: rows kept back at most; beyond
    it the oldest are released early.
    """

    def __init__(self, lateness: float, most: int) -> None:
        self.lateness, self.most = lateness, most
        self.waiting: list[TimedRow] = []
        self.newest = self.released = float("-inf")

    def put(self, row: TimedRow) -> str | None:
        """Take a row in. Returns `"reordered"` where it was not the newest, and `"doubled"` or `"late"` where it was
        left out."""
        time, waiting = row[0], self.waiting
        if time > self.newest + ROUNDING_S:
            waiting.append(row)
            self.newest = time
            return None
        if time <= self.released + ROUNDING_S:
            return "doubled" if time >= self.released - ROUNDING_S else "late"
        place = bisect_left(waiting, time, key=_time)
        near = [x[0] for x in waiting[max(place - 1, 0) : place + 1]]
        if any(abs(x - time) <= ROUNDING_S for x in near):
            return "doubled"
        waiting.insert(place, row)
        return "reordered"

    def ready(self) -> list[TimedRow]:
        """The rows that nothing can overtake any more, in order; they leave the buffer."""
        waiting = self.waiting
        edge = self.newest - self.lateness
        if not waiting or (waiting[0][0] > edge and len(waiting) <= self.most):
            return []
        count = max(bisect_left(waiting, edge, key=_time), len(waiting) - self.most)
        if count < len(waiting) and waiting[count][0] <= edge:
            count += 1
        return self._out(count)

    def drain(self) -> list[TimedRow]:
        """All rows, in order; they leave the buffer."""
        return self._out(len(self.waiting))

    def begin_anew(self) -> None:
        """Forget the clock, once drained: the next row may have any time."""
        self.newest = self.released = float("-inf")

    def _out(self, count: int) -> list[TimedRow]:
        out, self.waiting = self.waiting[:count], self.waiting[count:]
        if out:
            self.released = out[-1][0]
        return out


JUMP_S = 60.0
"""A row further from the newest one is on another clock, or its time is wrong [s]."""
CONFIRM = 5
"""Rows in order on another clock that show that the clock was set, and not one time wrong."""
GAP_S = 0.5
"""A step between rows beyond which a window ends early [s]; that of `BeliefStream`."""
LIMITS = {"accel_cmd": 100.0, "accel": 100.0, "speed": 200.0, "jerk": 10_000.0, "engaged": 1.0}
"""Sizes [SI] that no car exceeds."""
_WAITING = 5000  # rows kept back


class LiveWindow(NamedTuple):
    """A window of one car: its number from 1, what was seen, how far the stream's clock is ahead of the car's [s], and
    when its end had come (`time.monotonic`)."""

    number: int
    watched: WatchedWindow
    ahead: float
    ended: float


class LiveCar:
    """The watch of one car, fed row by row. `signals` are those of its first row.

    Raises `InputError` where they do not suffice for a form.
    """

    def __init__(self, name: str, signals: set[str], settings: LiveSettings, counts: Counts) -> None:
        form = settings.form_of(signals)
        if form is None:
            raise InputError(f"{name}: found {', '.join(sorted(signals))}; needs accel_cmd, and accel or speed")
        self.name, self.settings, self.counts = name, settings, counts
        self.form: Form = form
        more = [x for x in ("speed", "engaged") if x in signals and x not in form.columns]
        self.columns = (*form.columns, *more)
        self._engaged = self.columns[-1] == "engaged"
        self._limits = tuple(LIMITS[x] for x in self.columns)
        self.watch = settings.watch(name, form)
        self.order = ReorderBuffer(settings.lateness, _WAITING)
        self.position: int | None = None
        self.windows = 0
        self.p_string_stable = math.nan
        self.refusal: str | None = None  # of the last rows that were refused as a whole, in words
        self._ahead = 0.0
        self._suspects: list[TimedRow] = []
        self._pending: list[TimedRow] = []  # released, and not yet fed
        self._in_window = 0
        self._closes = -math.inf  # on the car's clock; where no window is open, the next row is fed at once
        self._last = -math.inf
        self._ended: float | None = None

    def take(self, row: Row, arrived: float, setting: Setting) -> list[LiveWindow]:
        """A row in, the windows out that it completes; one that is left out is counted."""
        timed = self._checked(row)
        if isinstance(timed, str):
            self.counts.refuse(timed)
            return []
        out: list[LiveWindow] = []
        if abs(row.time - self.order.newest) > JUMP_S and self.order.newest > -math.inf:
            if not self._clock_was_set(timed):
                return out
            out = self._begin_anew(arrived, setting)
        elif self._suspects:
            self.counts.refuse("jumped", len(self._suspects))
            self._suspects = []
        return out + self._put(timed, arrived, setting)

    def _put(self, timed: TimedRow, arrived: float, setting: Setting) -> list[LiveWindow]:
        fate = self.order.put(timed)
        if fate == "reordered":
            self.counts.reordered += 1
        elif fate is not None:
            self.counts.refuse(fate)
            return []
        self.counts.rows += 1
        if self._ended is None and timed[0] >= self._closes:
            self._ended = arrived
        out: list[LiveWindow] = []
        for ready in self.order.ready():
            self._pending.append(ready)
            self._in_window += 1
            if ready[0] >= self._closes or ready[0] > self._last + GAP_S:
                out += self._feed(arrived, setting)
            elif self._in_window > MOST_ROWS:
                self._pending.pop()
                self.counts.refuse("crowded")
            self._last = ready[0]
        return out

    def flush(self, arrived: float, setting: Setting) -> list[LiveWindow]:
        """All rows that were kept back, and the open window closed early: the source ended."""
        self._pending += self.order.drain()
        out = self._feed(arrived, setting)
        return out + self._windows(lambda: self.watch.flush(setting), 0, arrived)

    def _checked(self, row: Row) -> TimedRow | str:
        """The row as numbers, or why it is left out."""
        signals = row.signals
        try:
            values = [signals[name] for name in self.columns]
        except KeyError:
            return "incomplete"
        try:
            # a comparison with nan is false too
            for value, limit in zip(values, self._limits, strict=True):
                if not -limit <= value <= limit:
                    return "implausible"
            if self._engaged and values[-1] not in (0, 1):
                return "implausible"
            return (row.time, *map(float, values))
        except (TypeError, ValueError):
            return "incomplete" if None in values else "implausible"

    def _clock_was_set(self, timed: TimedRow) -> bool:
        """Whether this row and those before it show that the car's clock was set."""
        before = self._suspects[-1][0] if self._suspects else None
        if before is not None and abs(timed[0] - before) <= ROUNDING_S:
            self.counts.refuse("doubled")
            return False
        if before is not None and not 0.0 < timed[0] - before <= GAP_S:
            self.counts.refuse("jumped", len(self._suspects))
            self._suspects = []
        self._suspects.append(timed)
        return len(self._suspects) >= CONFIRM

    def _begin_anew(self, arrived: float, setting: Setting) -> list[LiveWindow]:
        """End what was on the old clock, and take in the rows on the new one but the last."""
        out = self.flush(arrived, setting)
        first, *rest = self._suspects[:-1]
        end = self.order.newest + self._ahead
        self._suspects = []
        self.order.begin_anew()
        self._ahead = end + self.settings.window - first[0]
        self._last = self._closes = -math.inf
        for timed in (first, *rest):
            out += self._put(timed, arrived, setting)
        return out

    def _feed(self, arrived: float, setting: Setting) -> list[LiveWindow]:
        if not self._pending:
            return []
        rows, self._pending = np.array(self._pending, dtype=np.float64).T, []
        time = rows[0]
        if self._ahead != 0.0:
            time = np.round(time + self._ahead, 6)  # the sum's own rounding must not show as uneven steps
        signals = {name: torch.from_numpy(rows[i + 1]) for i, name in enumerate(self.columns)}
        usable = signals["speed"] >= STANDSTILL_MPS if "speed" in signals else None
        engaged = signals.get("engaged")
        clock = torch.from_numpy(time)
        return self._windows(
            lambda: self.watch.feed(clock, signals, setting, usable=usable, engaged=engaged), len(time), arrived
        )

    def _windows(self, work: Any, rows: int, arrived: float) -> list[LiveWindow]:
        """The windows that `work` gives, numbered; what it refuses is counted, and the watch goes on."""
        self.refusal = None
        try:
            found: list[WatchedWindow] = work()
        except InputError as fault:
            self.counts.refuse("contradictory", rows)
            self.refusal, found = str(fault), []
        except (RuntimeError, ValueError, ArithmeticError) as fault:
            # numbers that no likelihood bears: the car begins with the first prior again
            self.counts.refuse("failed", rows)
            self.refusal, found = f"not computed ({type(fault).__name__}); the belief begins anew", []
            self.watch = self.settings.watch(self.name, self.form)
        ended = arrived if self._ended is None else self._ended
        out = []
        for watched in found:
            self.windows += 1
            self.p_string_stable = float(watched.report.p_string_stable[0])
            self.counts.alerts.update(watched.report.names())
            out.append(LiveWindow(self.windows, watched, self._ahead, ended))
        self.counts.windows += len(found)
        closes = self.watch.stream.closes_at
        # the stream itself allows for round-off in a clock that counts 0.01 s
        closes = -math.inf if closes is None else closes - self._ahead - 2 * ROUNDING_S
        if closes != self._closes:
            self._closes, self._in_window, self._ended = closes, 0, None
        return out

    def state_dict(self) -> dict[str, Any]:
        """All that later windows depend on, as tensors and plain values."""
        rows = {"waiting": self.order.waiting, "suspects": self._suspects, "pending": self._pending}
        width = 1 + len(self.columns)
        clock = (self.order.newest, self.order.released, self._ahead, self._closes, self._last)
        return {
            "car": self.name,
            "columns": list(self.columns),
            "watch": self.watch.state_dict(),
            "rows": {name: torch.tensor(x, dtype=torch.float64).reshape(-1, width) for name, x in rows.items()},
            "clock": torch.tensor(clock, dtype=torch.float64),
            "numbers": {"windows": self.windows, "in_window": self._in_window, "position": self.position},
            "p_string_stable": self.p_string_stable,
        }

    @classmethod
    def restored(cls, state: Mapping[str, Any], settings: LiveSettings, counts: Counts) -> LiveCar:
        """A car that goes on from `state_dict` to the bit. Raises `InputError` for anything else."""
        try:
            car = cls(state["car"], set(state["columns"]), settings, counts)
            if car.columns != tuple(state["columns"]):
                raise InputError(f"state: found the columns {state['columns']}, not {list(car.columns)}")
            car.watch.load_state_dict(state["watch"])
            rows = {
                name: _rows(state["rows"][name].numpy(), car.columns) for name in ("waiting", "suspects", "pending")
            }
            car.order.waiting, car._suspects, car._pending = rows["waiting"], rows["suspects"], rows["pending"]
            clock = state["clock"].tolist()
            car.order.newest, car.order.released, car._ahead, car._closes, car._last = clock
            car.windows, car._in_window = int(state["numbers"]["windows"]), int(state["numbers"]["in_window"])
            position = state["numbers"]["position"]
            car.position = None if position is None else int(position)
            car.p_string_stable = float(state["p_string_stable"])
        except (KeyError, TypeError, ValueError, AttributeError) as fault:
            if isinstance(fault, InputError):
                raise
            raise InputError(f"state: is not a car's ({type(fault).__name__})") from None
        return car


def _rows(saved: NDArray[Any], columns: tuple[str, ...]) -> list[TimedRow]:
    if saved.ndim != 2 or saved.shape[1] != 1 + len(columns) or not bool(np.isfinite(saved).all()):
        raise InputError("state: rows: are not those of a car")
    return [tuple(row) for row in saved.tolist()]
