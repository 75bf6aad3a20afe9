"""Are the columns of a stream in their units and signs? Stretches of windows are checked as :mod:`avtorch.io.validity`
checks a log: the change of a level over a span against the integral of its rate over the same span.

A stretch begins with a window and ends when it has been found right, or after LONGEST seconds without a result. Where
it is found wrong, all of its windows are rejected. The division of samples into blocks does not matter: rows are
checked window by window.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.inference.form import Rows
from avtorch.inference.jerk import JerkStatistics
from avtorch.io.units import GRAVITY
from avtorch.io.validity import ACCEL_FACTORS, LATER_S, MIN_SPANS, SAME_MOTION, SPANS_S, SPEED_FACTORS, may_be_late

RATES = (("speed", "accel"), ("accel", "jerk"))
"""Pairs of a level and its rate, among the columns of the forms."""
COMMAND = (0.02, 3.5)
"""Range of plausible gains; the limit for a log is lower, but ten seconds of a real race car gave 3.2."""
CHECKS_S = (9.5, 19.0, 38.0)
"""Seconds of a stretch after which it is checked; it is not kept beyond the last."""
DELAYS_S = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Delays [s] of the response to a command that are tried."""
STEP_S = 0.05
"""Rows kept of a stretch are this far apart [s] or farther; integrals over them are made from all rows."""
SURE = 0.95
"""Correlation from which a scale is accepted; a log, which is checked once and not every ten seconds, needs less."""
BREAK_S = 2.0
"""Time without rows [s] after which a new stretch begins."""
SWAPPED = 8.0
"""Standard errors by which both coefficients of the jerk must be negative, and nine tenths of it explained."""
_HINTS = {
    ("speed", "accel"): {f"speed is in {k}": v for k, v in SPEED_FACTORS.items()}
    | {f"accel is in {k}": v for k, v in ACCEL_FACTORS.items()},
    ("accel", "jerk"): {"accel is in g": 1 / GRAVITY, "accel is in cm/s2": 100.0, "jerk is in g/s": GRAVITY},
    ("speed", "accel_cmd"): {"accel_cmd is in g": GRAVITY, "accel_cmd is in cm/s2": 0.01, "speed is in km/h": 3.6},
    ("accel", "accel_cmd"): {"accel_cmd is in g": GRAVITY, "accel_cmd is in cm/s2": 0.01, "accel is in cm/s2": 100.0},
}


class Pair(NamedTuple):
    """A level, or the integral of ``level`` if ``integrated``, whose changes should equal those of the integral of
    ``rate``."""

    level: str
    rate: str
    integrated: bool
    limits: tuple[float, float]
    delays: tuple[float, ...]


class StreamUnits:
    """The present stretch of a stream, and the belief before it.

    `columns`: those of the form. `vehicles`: how many.
    """

    def __init__(self, columns: tuple[str, ...], vehicles: int) -> None:
        self.vehicles = vehicles
        self.pairs = [Pair(a, b, False, SAME_MOTION, (0.0,)) for a, b in RATES if a in columns and b in columns]
        if "accel_cmd" in columns and ("speed" in columns or "accel" in columns):
            level = "speed" if "speed" in columns else "accel"
            self.pairs.append(Pair(level, "accel_cmd", level == "accel", COMMAND, DELAYS_S))
        self.columns = tuple(dict.fromkeys(name for pair in self.pairs for name in (pair.level, pair.rate)))
        self.clear()

    def clear(self) -> None:
        """Begin a stretch with the next window."""
        self.rows: dict[str, FloatArray] = {}
        self.sums: Tensor | None = None
        self.checks = 0
        self.before: dict[str, Any] | None = None

    def take(self, rows: Rows, belief: dict[str, Any]) -> None:
        """Take in a window of rows that ``belief`` does not include yet.

        Raises `InputError` that names columns and vehicle, where the stretch proves a unit or sign wrong.
        """
        if not self.pairs or not len(rows["time"]):
            return
        breaks = (rows["time"].diff() > BREAK_S).nonzero().squeeze(-1)
        if len(breaks):
            begin = int(breaks[-1]) + 1
            rows = {name: value[..., begin:] for name, value in rows.items()}
        if self.before is not None and (len(breaks) or float(rows["time"][0] - self.rows["time"][-1]) > BREAK_S):
            self.clear()
        if self.before is None:
            self.before = belief
        self._append(rows)
        time = self.rows["time"]
        if float(time[-1] - time[0]) < CHECKS_S[self.checks]:
            return
        self.checks += 1
        sure = [self._check(pair) for pair in self.pairs]
        self._check_swap()
        if all(sure) or self.checks == len(CHECKS_S):
            self.clear()

    def _append(self, rows: Rows) -> None:
        """Integrals over all rows, kept at every STEP_S of them; in NumPy, whose calls cost a live watch less."""
        if {"accel_cmd", "accel", "jerk"} <= set(self.columns):
            statistics = JerkStatistics.from_samples(rows["accel"], rows["accel_cmd"], rows["jerk"], rows["usable"])
            sums = torch.stack([getattr(statistics, name) for name in ("n", "jj", "aj", "uj", "aa", "au", "uu")])
            self.sums = sums if self.sums is None else self.sums + sums
        time, usable = rows["time"].numpy(), rows["usable"].numpy()
        # a masked row may hold any number or NaN; (column, vehicle, time)
        values = np.where(usable, np.stack([rows[name].numpy() for name in self.columns]), 0.0)
        last = {name: value[..., -1:] for name, value in self.rows.items()}
        if last:
            time = np.concatenate([last["time"], time])
            usable = np.concatenate([last["usable"] > 0, usable], -1)
            values = np.concatenate([np.stack([last[name] for name in self.columns]), values], -1)
        steps = np.diff(time)
        usual = float(np.median(steps)) if len(steps) else math.inf
        lost = ~(usable[:, 1:] & usable[:, :-1]) | (steps > max(3 * usual, 0.1))
        parts = np.concatenate([lost[None].astype(np.float64), 0.5 * (values[..., 1:] + values[..., :-1]) * steps])
        names = ("lost", *(f"total {name}" for name in self.columns))
        begin = np.stack([last[name] for name in names]) if last else np.zeros((*parts.shape[:-1], 1))
        totals = np.concatenate([begin, begin + parts.cumsum(-1)], -1)
        every = max(1, int(STEP_S / usual + 1e-6)) if usual > 0 else 1
        # always keep the last row: the next window continues from it
        kept = np.unique(np.append(np.arange(1 if last else 0, len(time), every), len(time) - 1))
        new = {"time": time, "usable": usable.astype(np.float64)}
        new |= dict(zip(self.columns, values, strict=True)) | dict(zip(names, totals, strict=True))
        new = {name: value.take(kept, -1) for name, value in new.items()}
        self.rows = {name: np.concatenate([self.rows[name], x], -1) if last else x for name, x in new.items()}

    def _check(self, pair: Pair) -> bool:
        """Whether the stretch decides ``pair`` for every vehicle; raises InputError where one of them is wrong."""
        slope, correlation = self._best(pair)
        if len(pair.delays) > 1 and bool((correlation <= -SURE).any()):
            later = self._best(pair._replace(delays=LATER_S))
            late = (correlation <= -SURE) & may_be_late(later[1], known=later[1] != 0)
            slope, correlation = np.where(late, later[0], slope), np.where(late, later[1], correlation)
        sure = np.abs(correlation) >= SURE
        wrong = sure & ~((slope >= pair.limits[0]) & (slope <= pair.limits[1]))
        for v in np.flatnonzero(wrong).tolist():
            moves = f"{pair.level} responds with" if pair.integrated else f"{pair.level} changes"
            scale = f"{moves} {float(slope[v]):.3g} times as much as {pair.rate} implies"
            if float(slope[v]) < 0:
                raise self._refusal(v, pair.level, pair.rate, f"{scale}, so one has the wrong sign")
            hints = _HINTS[pair.level, pair.rate]
            near = min(hints, key=lambda name: abs(math.log(float(slope[v]) / hints[name])))
            raise self._refusal(v, pair.level, pair.rate, f"{scale}, so their units differ; perhaps {near}")
        return bool(sure.all())

    def _best(self, pair: Pair) -> tuple[FloatArray, FloatArray]:
        """Slope and correlation, each ``(vehicle,)``, at the delay and the span where they correlate best."""
        found = [self._compare(pair, span) for span in SPANS_S]
        slope, correlation = (np.concatenate(x) for x in zip(*found, strict=True))  # (span x delay, vehicle)
        # a periodic drive correlates as strongly, with the other sign, half a period off: the agreeing sign goes first
        best = (np.abs(correlation) + (correlation > 0.5)).argmax(0), np.arange(self.vehicles)
        return slope[best], correlation[best]

    def _compare(self, pair: Pair, span: float) -> tuple[FloatArray, FloatArray]:
        """Slope and correlation of level on rate for every delay, ``(delay, vehicle)``; a correlation of 0: unknown."""
        rows, time = self.rows, self.rows["time"]
        starts = np.arange(time[0] + max(pair.delays), time[-1] - span, span / 4)
        delays = np.array(pair.delays)[:, None]
        if len(starts) < 2:
            return np.zeros((len(delays), self.vehicles)), np.zeros((len(delays), self.vehicles))
        level = rows[f"total {pair.level}" if pair.integrated else pair.level]
        begun = starts - delays  # (delay, start)
        x = _change(time, rows[f"total {pair.rate}"], begun, begun + span)
        y = _change(time, level, starts, starts + span)[:, None]
        whole = _change(time, rows["lost"], begun, np.broadcast_to(starts + span, begun.shape)) < 0.5
        count = whole.sum(-1)

        def mean(value: FloatArray) -> FloatArray:
            return np.where(whole, value, 0.0).sum(-1) / np.maximum(count, 1)

        x, y = x - mean(x)[..., None], y - mean(y)[..., None]
        xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
        moves = (xx > 1e-12) & (yy > 1e-12) & (count >= 4 * MIN_SPANS - 4)
        correlation = np.where(moves, xy / np.sqrt(np.maximum(xx * yy, 1e-300)), 0.0)
        # as in a log: the slope by which the two would be alike in size, its sign that of the correlation
        slope = np.where(moves, correlation * np.sqrt(yy / np.maximum(xx, 1e-300)), 1.0)
        return slope.T, correlation.T

    def _check_swap(self) -> None:
        """Least squares of the jerk on ``(-accel, accel_cmd)``: where lag and gain are both negative, the columns are
        swapped."""
        if self.sums is None:
            return
        statistics = JerkStatistics(*self.sums)
        lag, gain, noise = statistics.least_squares()
        determinant = (statistics.aa * statistics.uu - statistics.au.square()).clamp_min(1e-300)
        enough = noise.square() * statistics.n < 0.1 * statistics.jj
        spread = noise / determinant.sqrt()
        by_lag, by_gain = lag / (spread * statistics.uu.sqrt()), gain / (spread * statistics.aa.sqrt())
        swapped = enough & (by_lag < -SWAPPED) & (by_gain < -SWAPPED)
        for v in swapped.nonzero().squeeze(-1).tolist():
            raise self._refusal(v, "accel", "accel_cmd", "accel leads accel_cmd, so the two may be swapped")

    def _refusal(self, vehicle: int, one: str, other: str, finding: str) -> InputError:
        start, end = float(self.rows["time"][0]), float(self.rows["time"][-1])
        which = f" of vehicle {vehicle}" if self.vehicles > 1 else ""
        return InputError(
            f"stream: columns {one!r} and {other!r}{which}, {start:.10g} to {end:.10g} s: {finding}; no estimate "
            f"from this time is kept"
        )

    def state_dict(self) -> dict[str, Any]:
        """Plain tensors and numbers."""
        rows = {name: torch.from_numpy(value) for name, value in self.rows.items()}
        return {"rows": rows, "sums": self.sums, "looks": self.checks, "before": self.before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict`.

        Raises `InputError` for what is no stretch's state.
        """
        if not isinstance(state, dict) or set(state) != {"rows", "sums", "looks", "before"}:
            raise InputError("state: units: not what a stream saves")
        self.rows = {name: value.numpy().copy() for name, value in state["rows"].items()}
        self.sums, self.checks, self.before = (state[key] for key in ("sums", "looks", "before"))


def _change(time: FloatArray, x: FloatArray, begin: FloatArray, end: FloatArray) -> FloatArray:
    """What ``x`` ``(vehicle, time)`` gains from ``begin`` to ``end`` ``(...)``, linear between rows; ``(vehicle,
    ...)``."""
    return np.stack([np.interp(end, time, own) - np.interp(begin, time, own) for own in x])
