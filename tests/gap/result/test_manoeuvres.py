"""Manoeuvres are found where they were commanded, and their figures are those of the signals that were made."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avtorch.arrays import FloatArray
from avtorch.gap.result.manoeuvres import Manoeuvre, manoeuvres
from avtorch.gap.result.traces import Traces

STEP = 0.05


def clock(rows: int) -> FloatArray:
    return np.linspace(0.0, STEP * (rows - 1), rows)


def answered(u: FloatArray, lag: float, gain: float = 1.0, delay: float = 0.0) -> FloatArray:
    """First order, exact for a held command."""
    keep, late = np.exp(-STEP / lag), round(delay / STEP)
    u = np.concatenate([np.full(late, u[0]), u[: len(u) - late]])
    a = np.empty_like(u)
    a[0] = gain * u[0]
    for i in range(1, len(u)):
        a[i] = keep * a[i - 1] + (1 - keep) * gain * u[i - 1]
    return a


def drive() -> tuple[FloatArray, FloatArray]:
    """Command and speed: a start, a ramp, a step, a braking, a stop, each alone for ten seconds."""
    time = clock(1200)
    knots = [0, 2, 2.05, 12, 12.05, 20, 23, 30, 30.05, 34, 34.05, 44, 44.05, 60]
    values = [0, 0, 1.2, 1.2, 0, 0, 1.0, 1.0, 0, 0, -2.5, -2.5, 0, 0]
    u = np.interp(time, knots, values)
    return u, np.maximum(np.cumsum(answered(u, 0.3)) * STEP, 0.0)


def found_in(
    u: FloatArray, speed: FloatArray, *, channels: tuple[str, ...] = ("speed", "accel")
) -> tuple[Manoeuvre, ...]:
    car, bare, named = answered(u, 0.5, 0.8, 0.2), answered(u, 0.2), answered(u, 0.5, 0.8, 0.2)
    each = []
    for a in (car, bare, named):
        both = {"speed": speed if a is car else np.cumsum(a) * STEP, "accel": a}
        each.append(np.stack([both[name] for name in channels]))
    zeros = np.zeros(len(u))
    car_s, bare_s, named_s = each
    traces = Traces(clock(len(u)), u, channels, car_s, bare_s, named_s, zeros, zeros.astype(int))
    return manoeuvres(traces)


def test_each_kind_is_found_where_it_was_commanded() -> None:
    found = {(m.kind, round(m.begin)) for m in found_in(*drive())}
    assert {("start", 2), ("step", 12), ("braking", 34)} <= found


def test_a_slow_change_is_a_ramp() -> None:
    time = clock(600)
    (ramp,) = found_in(np.interp(time, [0, 10, 13, 30], [0, 0, 1.0, 1.0]), np.full(600, 20.0))
    assert (ramp.kind, ramp.begin, ramp.end) == ("ramp", pytest.approx(10.0, abs=0.1), pytest.approx(13.0, abs=0.1))


def test_they_do_not_overlap_and_come_by_their_share_of_the_error() -> None:
    found = found_in(*drive())
    assert 3 <= len(found) <= 6
    assert all(a.share >= b.share for a, b in pairwise(found))
    assert sum(m.share for m in found) <= 1
    spans = sorted((m.rows.start, m.rows.stop) for m in found)
    assert all(a[1] <= b[0] for a, b in pairwise(spans))


def test_figures_are_those_of_the_responses() -> None:
    (braking,) = (m for m in found_in(*drive()) if m.kind == "braking")
    responses = braking.responses
    assert responses["command"].peak == -2.5
    # ten time constants later
    assert responses["measured"].peak == pytest.approx(0.8 * -2.5, rel=0.01)
    assert responses["baseline simulator"].peak == pytest.approx(-2.5, rel=0.01)
    # of a first order ln 9 time constants; a row either way
    assert responses["measured"].rise == pytest.approx(np.log(9) * 0.5, abs=STEP)
    assert responses["baseline simulator"].rise == pytest.approx(np.log(9) * 0.2, abs=STEP)
    lags = {name: r.lag for name, r in responses.items()}
    assert lags["command"] == pytest.approx(0.0, abs=STEP / 2)
    assert lags["measured"] is not None
    assert lags["baseline simulator"] is not None
    # delay and lag of the one, the lag of the other: a correlation weighs them by the whole response
    assert lags["baseline simulator"] < 0.3 < lags["measured"] < 0.9
    assert responses["with what was named"] == responses["measured"]


def test_a_log_without_acceleration_has_the_slope_of_its_speed() -> None:
    (braking,) = (m for m in found_in(*drive(), channels=("speed",)) if m.kind == "braking")
    assert braking.responses["baseline simulator"].peak == pytest.approx(-2.5, rel=0.02)


def test_a_steady_drive_has_none() -> None:
    assert found_in(np.zeros(400), np.full(400, 20.0)) == ()


def test_no_manoeuvre_reaches_over_a_gap() -> None:
    u, _ = drive()
    time = clock(len(u))
    zeros = np.zeros(len(u))
    a = answered(u, 0.4)[None]
    stretch = np.where(time < 36.0, 0, 1)
    traces = Traces(time, u, ("accel",), a, u[None], a, zeros, stretch)
    for m in manoeuvres(traces):
        assert len(np.unique(stretch[m.rows])) == 1
