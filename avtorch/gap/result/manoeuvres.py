"""The manoeuvres of a drive, found by its commands, and how car and simulator answered: peak, rise, lag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from avtorch.arrays import FloatArray, IntArray
from avtorch.gap.result.traces import Traces

BEFORE_S, AFTER_S = 1.0, 4.0
"""What is shown before a manoeuvre begins and after it has ended [s]."""
_MOST = 6
_JUMP_S = 0.5  # within which a step is commanded
_LONGEST_S = 6.0  # of a manoeuvre
_PAUSE_S = 0.3  # within which a change that rests still goes on
_SHARE = 0.3  # of the command's 90 % range, from which a change counts
_LEAST = 0.3  # [m/s²] from which a change counts
_SLOW = 1.0  # [m/s] below which the car begins from or comes to rest
_LATEST_S = 3.0  # lag that is looked for
_ALIKE = 0.5  # correlation from which a lag has a meaning
_SLOPE_S = 0.4  # over which an acceleration is taken from a speed


@dataclass(frozen=True)
class Response:
    """How one signal answered: its `peak` [m/s²], the time `rise` [s] from 10 to 90 % of the way there, and its `lag`
    [s] behind the command; None where it does not move the command's way, or does not follow it.
    """

    peak: float
    rise: float | None
    lag: float | None


@dataclass(frozen=True)
class Manoeuvre:
    """A stretch of the drive in which the command does one thing: `kind`, a start, a stop, braking, a step or a ramp.

    `log`: the number of its log; `rows`: among the traces, with a second before and four after; `begin` and `end` [s]
    of the change itself, on the traces' time; `share`: of the squared error of the simulator over the whole drive that
    lies within `rows`.
    `lines` (row,) of accelerations [m/s²] by name, the command first; `responses` by the same names.
    """

    kind: str
    log: int
    rows: slice
    begin: float
    end: float
    change: float
    share: float
    lines: Mapping[str, FloatArray] = field(repr=False)
    responses: Mapping[str, Response] = field(repr=False)


def manoeuvres(traces: Traces, *, named: bool = True) -> tuple[Manoeuvre, ...]:
    """The manoeuvres in which the simulator errs most, six at most, none overlapping another; the worst first.

    `named`: the repaired simulator is among their lines. No kind takes more than half of the places while another is
    left. Accelerations are taken from the speed's slope where they were not measured.

    Example:
        >>> import numpy as np
        >>> from avtorch.gap.result.manoeuvres import manoeuvres
        >>> from avtorch.gap.result.traces import Traces
        >>> time = np.arange(0.0, 30.0, 0.05)
        >>> u = np.where((time > 10) & (time < 15), -2.0, 0.0)
        >>> a = np.where((time > 10.4) & (time < 15.4), -2.0, 0.0)
        >>> traces = Traces(time, u, ("accel",), a[None], u[None], a[None], u, np.zeros(600, int))
        >>> found = manoeuvres(traces)[0]
        >>> found.kind, round(found.responses["measured"].lag, 1), round(found.responses["baseline simulator"].lag, 1)
        ('braking', 0.4, 0.0)
    """
    if len(traces.time) < 2:
        return ()
    step = traces.step
    low, high = np.quantile(traces.command, (0.05, 0.95))
    least = max(_LEAST, _SHARE * float(high - low))
    names = ("measured", "baseline simulator", "with what was named")
    lines = {"command": traces.command} | dict(zip(names, traces.accelerations(_SLOPE_S), strict=True))
    if not named:
        del lines["with what was named"]
    before = lines["measured"] - lines["baseline simulator"]
    energy = np.concatenate([[0.0], np.cumsum(before**2)])
    whole = float(energy[-1]) or 1.0
    found = []
    for stretch in traces.stretches:
        for first, last in _changes(traces.command, stretch, step, least):
            kind = _kind(traces, stretch, first, last, step, least)
            begin = max(first - round(BEFORE_S / step), stretch[0])
            end = min(last + round(AFTER_S / step), stretch[-1]) + 1
            found.append((float(energy[end] - energy[begin]) / whole, kind, first, last, slice(begin, end)))
    found.sort(reverse=True, key=lambda change: change[0])
    out = []
    for share, kind, first, last, rows in _chosen(found):
        change = float(traces.command[last] - traces.command[first])
        part = {name: values[rows] for name, values in lines.items()}
        responses = {name: _response(part["command"], values, change, step) for name, values in part.items()}
        begin, end = float(traces.time[first]), float(traces.time[last])
        out.append(Manoeuvre(kind, int(traces.log[first]), rows, begin, end, change, share, part, responses))
    return tuple(out)


_Change = tuple[float, str, int, int, slice]
"""Share of the error, kind, first and last row of the change, and the rows about it."""


def _chosen(ranked: Sequence[_Change]) -> list[_Change]:
    taken: list[_Change] = []
    for limit in (_MOST // 2, _MOST):
        for each in ranked:
            apart = all(each[4].stop <= other[4].start or other[4].stop <= each[4].start for other in taken)
            if apart and len(taken) < _MOST and sum(other[1] == each[1] for other in taken) < limit:
                taken.append(each)
    return sorted(taken, reverse=True, key=lambda change: change[0])


def _changes(command: FloatArray, stretch: IntArray, step: float, least: float) -> list[tuple[int, int]]:
    """First and last row of every change of the command in one direction within a stretch, without longer rests."""
    u = command[stretch]
    pause, longest = max(1, round(_PAUSE_S / step)), round(_LONGEST_S / step)
    steps = np.sign(np.where(np.abs(np.diff(u)) > 1e-3, np.diff(u), 0.0))
    runs: list[tuple[int, int]] = []
    for k in np.flatnonzero(steps).tolist():
        first, last = runs[-1] if runs else (0, 0)
        if runs and steps[k] == steps[first] and k - last <= pause and k - first <= longest:
            runs[-1] = first, k
        else:
            runs.append((k, k))
    return [(int(stretch[i]), int(stretch[j + 1])) for i, j in runs if abs(u[j + 1] - u[i]) >= least]


def _kind(traces: Traces, stretch: IntArray, first: int, last: int, step: float, least: float) -> str:
    u, speed = traces.command, traces.speed
    if speed is not None:
        if u[last] > u[first] and speed[first] < _SLOW:
            return "start"
        if u[last] < 0 and speed[min(last + round(AFTER_S / step), stretch[-1])] < _SLOW < speed[first]:
            return "stop"
    if u[last] < u[first] and u[last] <= -least:
        return "braking"
    return "step" if traces.time[last] - traces.time[first] <= _JUMP_S else "ramp"


def _response(command: FloatArray, line: FloatArray, change: float, step: float) -> Response:
    side = 1.0 if change > 0 else -1.0
    peak = float(line[(side * line).argmax()])
    start = float(line[: max(1, round(0.5 / step))].mean())
    way = side * (peak - start)
    first, last = (_crossing(side * (line - start), share * way) for share in (0.1, 0.9))
    rise = (last - first) * step if way > 0 else None
    return Response(peak, rise or None, _lag(command, line, step))


def _crossing(values: FloatArray, level: float) -> float:
    """Place, between rows, at which `values` first rise to `level`, which they reach."""
    i = int((values >= level).argmax())
    return float(i) if i == 0 else i - 1 + float((level - values[i - 1]) / (values[i] - values[i - 1]))


def _lag(command: FloatArray, line: FloatArray, step: float) -> float | None:
    """By which `line` follows the command best, between rows by a parabola."""
    most = min(round(_LATEST_S / step), len(command) // 2)
    fits = np.array([_alike(command[: len(command) - k], line[k:]) for k in range(most + 1)])
    best = int(fits.argmax())
    if fits[best] < _ALIKE or best == most:
        return None
    if best == 0:
        return 0.0
    a, b, c = (float(x) for x in fits[best - 1 : best + 2])
    bend = a - 2 * b + c
    return (best + (0.5 * (a - c) / bend if bend < 0 else 0.0)) * step


def _alike(u: FloatArray, y: FloatArray) -> float:
    u, y = u - u.mean(), y - y.mean()
    size = float(np.sqrt((u @ u) * (y @ y)))
    return float(u @ y) / size if size > 0 else 0.0
