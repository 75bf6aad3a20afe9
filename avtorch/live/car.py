"""Cars watched while they drive: rows put in order, each car's open window, belief and monitor, and its answers."""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from operator import itemgetter
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from avtorch.decision.monitor import Monitor
from avtorch.decision.settings import Setting
from avtorch.decision.watch import Watch, WatchedWindow
from avtorch.errors import InputError
from avtorch.inference.form import Form
from avtorch.inference.jerk import JerkForm
from avtorch.inference.latent import LatentForm
from avtorch.inference.stream import BeliefStream
from avtorch.io.clock import ROUNDING_S
from avtorch.io.log import STANDSTILL_MPS
from avtorch.live.source import Batch, Counts, Row
from avtorch.results import window_entry
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
    (T_L [s], K_L [-]) of a sound car; `lateness` [s] by which a row may come behind newer ones; `cars` at most; `seed`.

    Raises `InputError` for numbers out of range.
    """

    window: float = 2.0
    form: FormName = "auto"
    estimator: str = "auto"
    mode: str = "lambda"
    time_gap: float = 1.0
    gains: tuple[float, float, float] = NOMINAL_GAINS
    accepted: tuple[float, float] = (0.3, 1.0)
    lateness: float = 0.05
    cars: int = 1000
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
        options: dict[str, Any] = {"seed": int.from_bytes(digest[:6], "big")}
        estimator = self.estimator
        if estimator == "auto":
            estimator = "map" if isinstance(form, JerkForm) else "importance"
        if estimator in ("sgld", "map", "importance"):
            options["mode"] = self.mode
        stream = BeliefStream(window=self.window, form=form, estimator=estimator, **options)
        return Watch(stream, Monitor(accepted=self.accepted))

    def to_dict(self) -> dict[str, str]:
        """By name, as text: what a state belongs to. The number of cars may change."""
        return {name: str(value) for name, value in asdict(self).items() if name != "cars"}


TimedRow = tuple[float, ...]
"""Time [s], then the values of the car's columns."""


_time = itemgetter(0)


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
        place = bisect_left(waiting, time - ROUNDING_S, key=_time)
        if place < len(waiting) and waiting[place][0] <= time + ROUNDING_S:
            return "doubled"
        waiting.insert(place, row)
        return "reordered"

    def ready(self) -> list[TimedRow]:
        """The rows that nothing can overtake any more, in order; they leave the buffer."""
        count = bisect_right(self.waiting, self.newest - self.lateness, key=_time)
        return self.out(max(count, len(self.waiting) - self.most))

    def out(self, count: int) -> list[TimedRow]:
        """The first rows, in order; they leave the buffer."""
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


class Answer(NamedTuple):
    """What is said of one window: the object that becomes a line of JSON, the car's name, the number of the window, and
    when its end had come (`time.monotonic`; None where it is no window).
    """

    entry: dict[str, Any]
    car: str
    number: int
    ended: float | None


_KEPT = ("windows", "p_string_stable", "_ahead", "_suspects", "_pending", "_in_window", "_closes", "_last")


class LiveCar:
    """The watch of one car, fed row by row. `signals` are those of its first row, which suffice for a form."""

    def __init__(self, name: str, signals: set[str], settings: LiveSettings, counts: Counts) -> None:
        form = settings.form_of(signals)
        assert form is not None
        self.name, self.settings, self.counts = name, settings, counts
        self._setting = settings.setting()
        self.form: Form = form
        more = [x for x in ("speed", "engaged") if x in signals and x not in form.columns]
        self.columns = (*form.columns, *more)
        self._engaged = self.columns[-1] == "engaged"
        self._limits = tuple(LIMITS[x] for x in self.columns)
        self.watch = settings.watch(name, form)
        self.order = ReorderBuffer(settings.lateness, _WAITING)
        self.windows = 0
        self.p_string_stable = math.nan
        self._ahead = 0.0
        self._suspects: list[TimedRow] = []
        self._pending: list[TimedRow] = []  # released, and not yet fed
        self._in_window = 0
        self._closes = -math.inf  # on the car's clock; where no window is open, the next row is fed at once
        self._last = -math.inf
        self._ended: float | None = None

    def take(self, row: Row, arrived: float) -> list[Answer]:
        """A row in, the answers out for the windows that it completes; one that is left out is counted."""
        timed = self._checked(row)
        if isinstance(timed, str):
            self.counts.refuse(timed)
            return []
        out: list[Answer] = []
        if abs(row.time - self.order.newest) > JUMP_S and self.order.newest > -math.inf:
            if not self._clock_was_set(timed):
                return out
            out = self._begin_anew(arrived)
        elif self._suspects:
            self.counts.refuse("jumped", len(self._suspects))
            self._suspects = []
        return out + self._put(timed, arrived)

    def _put(self, timed: TimedRow, arrived: float) -> list[Answer]:
        fate = self.order.put(timed)
        if fate == "reordered":
            self.counts.reordered += 1
        elif fate is not None:
            self.counts.refuse(fate)
            return []
        self.counts.rows += 1
        if self._ended is None and timed[0] >= self._closes:
            self._ended = arrived
        out: list[Answer] = []
        for ready in self.order.ready():
            self._pending.append(ready)
            self._in_window += 1
            if ready[0] >= self._closes or ready[0] > self._last + GAP_S:
                out += self._feed(arrived)
            elif self._in_window > MOST_ROWS:
                self._pending.pop()
                self.counts.refuse("crowded")
            self._last = ready[0]
        return out

    def flush(self, arrived: float) -> list[Answer]:
        """All rows that were kept back, and the open window closed early: the source ended."""
        self._pending += self.order.out(len(self.order.waiting))
        out = self._feed(arrived)
        return out + self._answers(lambda: self.watch.flush(self._setting), 0, arrived)

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

    def _begin_anew(self, arrived: float) -> list[Answer]:
        """End what was on the old clock, and take in the rows on the new one but the last."""
        out = self.flush(arrived)
        first, *rest = self._suspects[:-1]
        end = self.order.newest + self._ahead
        self._suspects = []
        self.order.newest = self.order.released = -math.inf
        self._ahead = end + self.settings.window - first[0]
        self._last = self._closes = -math.inf
        for timed in (first, *rest):
            out += self._put(timed, arrived)
        return out

    def _feed(self, arrived: float) -> list[Answer]:
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
        return self._answers(
            lambda: self.watch.feed(clock, signals, self._setting, usable=usable, engaged=engaged), len(time), arrived
        )

    def _answers(self, work: Callable[[], list[WatchedWindow]], rows: int, arrived: float) -> list[Answer]:
        """The windows that `work` gives, numbered; what it refuses is counted and said, and the watch goes on."""
        found, refusal = [], None
        try:
            found = work()
        except InputError as fault:
            self.counts.refuse("contradictory", rows)
            refusal = str(fault)
        except (RuntimeError, ValueError, ArithmeticError) as fault:
            # numbers that no likelihood bears: the car begins with the first prior again
            self.counts.refuse("failed", rows)
            refusal = f"not computed ({type(fault).__name__}); the belief begins anew"
            self.watch = self.settings.watch(self.name, self.form)
        out = []
        for watched in found:
            self.windows += 1
            self.p_string_stable = float(watched.report.p_string_stable[0])
            self.counts.alerts.update(watched.report.names())
            entry = window_answer(self.name, self.windows, watched, self._ahead)
            out.append(Answer(entry, self.name, self.windows, arrived if self._ended is None else self._ended))
        self.counts.windows += len(found)
        if refusal is not None:
            entry = {"car": self.name, "after_window": self.windows, "refused": refusal}
            out.append(Answer(entry, self.name, self.windows, None))
        closes = self.watch.stream.closes_at
        # the stream itself allows for round-off in a clock that counts 0.01 s
        closes = -math.inf if closes is None else closes - self._ahead - 2 * ROUNDING_S
        if closes != self._closes:
            self._closes, self._in_window, self._ended = closes, 0, None
        return out

    def state_dict(self) -> dict[str, Any]:
        """All that later windows depend on, as tensors and plain values."""
        return {
            "car": self.name,
            "columns": self.columns,
            "watch": self.watch.state_dict(),
            "order": vars(self.order),
            "own": {name: getattr(self, name) for name in _KEPT},
        }

    @classmethod
    def restored(cls, state: Mapping[str, Any], settings: LiveSettings, counts: Counts) -> LiveCar:
        """A car that goes on from `state_dict` to the bit."""
        car = cls(state["car"], set(state["columns"]), settings, counts)
        car.watch.load_state_dict(state["watch"])
        vars(car).update(state["own"])
        vars(car.order).update(state["order"])
        return car


def window_answer(car: str, number: int, watched: WatchedWindow, ahead: float = 0.0) -> dict[str, Any]:
    """A line of `avtorch watch`: the entry of a window as in `estimates.json`, on the car's own clock, with the car,
    the window's number and a sentence for every alert. `ahead`: of the stream's clock on the car's [s]."""
    entry = window_entry(watched)
    if ahead != 0.0:
        entry |= {key: round(entry[key] - ahead, 6) for key in ("start_s", "end_s")}
    form = "jerk" if "sigma" in watched.window.belief.names else "latent"
    why = [watched.report.why(name) for name in watched.report.names()]
    return {"car": car, "window": number, "form": form, **entry, "why": why}


class LiveWatch:
    """Watches of many cars, one each, made when a car's first row comes."""

    def __init__(self, settings: LiveSettings | None = None, counts: Counts | None = None) -> None:
        self.settings = LiveSettings() if settings is None else settings
        self.counts = Counts() if counts is None else counts
        self.cars: dict[str, LiveCar] = {}

    def take(self, batch: Batch) -> list[Answer]:
        """Take in a batch; returns what is to be said, in the order of the rows that ended the windows."""
        answers: list[Answer] = []
        for row in batch.rows:
            car = self.cars.get(row.car) or self._new(row)
            if car is not None:
                answers += car.take(row, batch.arrived)
        return answers

    def flush(self, arrived: float) -> list[Answer]:
        """Close the open windows of all cars: the source ended for good."""
        return [answer for car in self.cars.values() for answer in car.flush(arrived)]

    def _new(self, row: Row) -> LiveCar | None:
        """The watch of a car that has not been seen before; None, and counted, where there can be none."""
        signals = {name for name, value in row.signals.items() if value is not None}
        if self.settings.form_of(signals) is None:
            self.counts.refuse("incomplete")
            return None
        if len(self.cars) >= self.settings.cars:
            self.counts.refuse("too many cars")
            return None
        return self.cars.setdefault(row.car, LiveCar(row.car, signals, self.settings, self.counts))
