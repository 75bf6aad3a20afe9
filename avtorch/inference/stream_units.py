"""Are the columns of a stream in their units and signs? Stretches of windows are checked as :mod:`avtorch.io.validity`
checks a log: the change of a level over a span against the integral of its rate over the same span.

A stretch begins with a window and ends when it has been found right, or after LONGEST seconds without a result. Where
it is found wrong, all of its windows are rejected. The division of samples into blocks does not matter: rows are
checked window by window.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from avtorch.arrays import FloatArray
from avtorch.errors import InputError
from avtorch.inference.form import Rows
from avtorch.inference.jerk import JerkStatistics
from avtorch.io.units import GRAVITY
from avtorch.io.validity import ACCEL_FACTORS, SAME_MOTION, SPEED_FACTORS, integral, late_response, scale_between

RATES = (("speed", "accel"), ("accel", "jerk"))
"""Pairs of a level and its rate, among the columns of the forms."""
COMMAND = (0.02, 3.5)
"""Range of plausible gains; the limit for a log is lower, but ten seconds of a real race car gave 3.2."""
CHECKS_S = (9.5, 19.0, 38.0)
"""Seconds of a stretch after which it is checked; it is not kept beyond the last."""
DELAYS_S = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Delays [s] of the response to a command that are tried."""
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


class StreamUnits:
    """The present stretch of a stream, and the belief before it.

    `columns`: those of the form. `vehicles`: how many.
    """

    def __init__(self, columns: tuple[str, ...], vehicles: int) -> None:
        self.columns, self.vehicles = columns, vehicles
        self.pairs = [pair for pair in RATES if set(pair) <= set(columns)]
        if "accel_cmd" in columns and ("speed" in columns or "accel" in columns):
            self.pairs.append(("speed" if "speed" in columns else "accel", "accel_cmd"))
        self.clear()

    def clear(self) -> None:
        """Begin a stretch with the next window."""
        self.rows: dict[str, FloatArray] = {}
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
        usable = rows["usable"].numpy()
        # a masked row may hold any number or NaN
        new = {name: np.where(usable, rows[name].numpy(), 0.0) for name in self.columns}
        new |= {"time": rows["time"].numpy(), "usable": usable.astype(np.float64)}
        self.rows = {name: np.concatenate([self.rows[name], x], -1) if self.rows else x for name, x in new.items()}
        time = self.rows["time"]
        if float(time[-1] - time[0]) < CHECKS_S[self.checks]:
            return
        self.checks += 1
        sure = [self._check(v, *pair) for v in range(self.vehicles) for pair in self.pairs]
        self._check_swap()
        if all(sure) or self.checks == len(CHECKS_S):
            self.clear()

    def _check(self, vehicle: int, level: str, rate: str) -> bool:
        """Whether the stretch decides a pair for a vehicle; raises InputError where it is wrong."""
        time, parts = self.rows["time"], self._parts(vehicle)
        x, y = self.rows[rate][vehicle], self.rows[level][vehicle]
        command = rate == "accel_cmd"
        if command and level == "accel":
            y = integral(time, y)
        found = scale_between(time, parts, y, x, delays=DELAYS_S if command else (0.0,))
        if command and found is not None and found.correlation <= -SURE:
            later, possible = late_response(time, parts, y, x)
            found = later if possible else found
        if found is None or abs(found.correlation) < SURE:
            return False
        low, high = COMMAND if command else SAME_MOTION
        if low <= found.slope <= high:
            return True
        moves = f"{level} responds with" if command and level == "accel" else f"{level} changes"
        scale = f"{moves} {found.slope:.3g} times as much as {rate} implies"
        if found.slope < 0:
            raise self._refusal(vehicle, level, rate, f"{scale}, so one has the wrong sign")
        hints = _HINTS[level, rate]
        near = min(hints, key=lambda name: abs(math.log(found.slope / hints[name])))
        raise self._refusal(vehicle, level, rate, f"{scale}, so their units differ; perhaps {near}")

    def _parts(self, vehicle: int) -> list[slice]:
        """The stretches of a vehicle's usable rows without a gap."""
        time, usable = self.rows["time"], self.rows["usable"][vehicle] > 0
        steps = np.diff(time)
        lost = ~(usable[1:] & usable[:-1]) | (steps > max(3 * float(np.median(steps)), 0.1))
        edges = [0, *(np.flatnonzero(lost) + 1).tolist(), len(time)]
        return [slice(first, last) for first, last in pairwise(edges)]

    def _check_swap(self) -> None:
        """Least squares of the jerk on ``(-accel, accel_cmd)``: where lag and gain are both negative, the columns are
        swapped."""
        if not {"accel_cmd", "accel", "jerk"} <= set(self.columns):
            return
        a, u, jerk = (torch.from_numpy(self.rows[name]) for name in ("accel", "accel_cmd", "jerk"))
        statistics = JerkStatistics.from_samples(a, u, jerk, torch.from_numpy(self.rows["usable"] > 0))
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
        return {"rows": rows, "checks": self.checks, "before": self.before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state_dict`.

        Raises `InputError` for what is no stretch's state.
        """
        if not isinstance(state, dict) or set(state) != {"rows", "checks", "before"}:
            raise InputError("state: units: not what a stream saves")
        self.rows = {name: value.numpy().copy() for name, value in state["rows"].items()}
        self.checks, self.before = state["checks"], state["before"]
