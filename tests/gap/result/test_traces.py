"""The fit of a rollout, by what its definition says of simple signals."""

from __future__ import annotations

import numpy as np
import pytest

from avtorch.gap.result.traces import Traces


def test_the_fit_of_the_exact_the_mean_and_a_known_error() -> None:
    time = np.linspace(0.0, 20 * np.pi, 2001)[:-1]  # whole periods
    measured = np.stack([np.sin(time), 20 + 3 * np.sin(time)])
    wrong = measured + np.array([[0.25], [3.0]]) * np.cos(time)  # as large as a quarter of the spread, and as all of it
    zeros = np.zeros(len(time))
    traces = Traces(time, zeros, ("accel", "another"), measured, measured, wrong, zeros, zeros.astype(int))
    assert traces.fit(traces.before).tolist() == [100.0, 100.0]
    assert traces.fit(traces.after) == pytest.approx([75.0, 0.0], abs=1e-9)
    mean = np.broadcast_to(measured.mean(axis=1, keepdims=True), measured.shape)
    assert traces.fit(mean) == pytest.approx([0.0, 0.0], abs=1e-9)
    # an offset is an error, as is a simulator worse than the mean
    assert traces.fit(measured + 6.0)[1] == pytest.approx(100 * (1 - 6 / (3 / np.sqrt(2))))


def test_a_channel_that_stands_still_has_no_fit() -> None:
    still, zeros = np.full((1, 50), 4.0), np.zeros(50)
    traces = Traces(np.arange(50.0), zeros, ("speed",), still, still, still, zeros, zeros.astype(int))
    assert np.isnan(traces.fit(traces.after)).all()


def test_a_simulated_speed_begins_anew_every_ten_seconds_and_in_each_stretch() -> None:
    time = 0.05 * np.concatenate([np.arange(500), np.arange(600, 700)])  # 25 s, 5 s without rows, 5 s
    stretch = np.repeat([0, 1], [500, 100])
    speed, zeros = 20 + np.sin(time), np.zeros(600)
    drifting = speed + 7.0 + 0.4 * time
    traces = Traces(time, zeros, ("speed",), speed[None], drifting[None], speed[None], zeros, stretch)
    assert [run.stop - run.start for run in traces.runs] == [200, 200, 100, 100]
    off = traces.begun_anew(traces.before)[0] - speed
    since = np.concatenate([0.05 * (np.arange(500) % 200), 0.05 * np.arange(100)])
    # from the mean of the first half second, 10 rows, on
    np.testing.assert_allclose(off, 0.4 * (since - 0.225), atol=1e-9)
    np.testing.assert_allclose(traces.begun_anew(traces.after)[0], speed)
    accel = Traces(time, zeros, ("accel",), speed[None], drifting[None], speed[None], zeros, stretch)
    assert accel.begun_anew(accel.before) is accel.before
