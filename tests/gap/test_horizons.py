"""Every rollout error is that of rollouts of the length in its label: computed here again from the label alone."""

from __future__ import annotations

import re
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.typing import NDArray

import avtorch
from avtorch.gap import DeadTime, plant
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.io import Log
from avtorch.plots.diagnosis import shrinkage
from avtorch.report import report_html
from tests.gap.records import log_of
from tests.overridden import taken_over

SETTLED_S = 2.0  # of a drive do not count


@pytest.fixture(scope="module")
def late() -> tuple[Log, Diagnosis]:
    log = log_of(plant([DeadTime(0.3)], T_L=0.4, K_L=0.9), seconds=90.0)
    return log, avtorch.diagnose(log, effects=["dead_time"], pairs=False)


def rolled(log: Log, T_L: float, K_L: float, channel: str, horizon_s: float) -> float:
    """Root mean square over rows and rollouts of GLVD, one begun at each row: an acceleration at the measured one, a
    speed at the measured one with the actuator where the commands have brought it."""
    assert log.accel_cmd is not None
    dt = 1 / log.rate_hz
    keep = np.exp(-dt / T_L)
    measured: NDArray[Any] = getattr(log, channel)
    driven = np.zeros(log.rows)
    for k in range(log.rows - 1):
        driven[k + 1] = keep * driven[k] + (1 - keep) * K_L * log.accel_cmd[k]
    begin = np.arange(round(SETTLED_S / dt), log.rows)
    accel = (measured if channel == "accel" else driven)[begin].copy()
    gained = np.zeros(len(begin))
    sums, counts = np.zeros(log.rows), np.zeros(log.rows)
    for age in range(round(horizon_s / dt)):
        rows = begin + age
        there = rows < log.rows
        told = accel if channel == "accel" else measured[begin] + gained
        sums[rows[there]] += (measured[rows[there]] - told[there]) ** 2
        counts[rows[there]] += 1
        demand = K_L * log.accel_cmd[np.minimum(rows, log.rows - 1)]
        after = keep * accel + (1 - keep) * demand
        gained = gained + demand * dt - T_L * (after - accel)
        accel = after
    return float(np.sqrt((sums[begin] / counts[begin]).mean()))


@pytest.mark.slow
def test_the_gap_is_over_the_horizon_that_it_names(late: tuple[Log, Diagnosis]) -> None:
    log, found = late
    told = found.to_dict()["gap"]["rollout"]
    assert told["horizon_s"] == 10.0
    for channel in ("accel", "speed"):
        want = rolled(log, found.baseline["T_L"].mean, found.baseline["K_L"].mean, channel, told["horizon_s"])
        # the answer was taken at the mode, here it is at the mean
        assert told[f"rmse_{channel}"] == pytest.approx(want, rel=0.02), channel


@pytest.mark.slow
def test_what_was_held_out_too_and_it_is_the_same_measure(late: tuple[Log, Diagnosis]) -> None:
    log, found = late
    answer = found.to_dict()
    metrics = answer["shrinkage"]["by_metric"]
    for channel in ("accel", "speed"):
        for horizon in ("_0.5s", "_2s", ""):
            told = metrics[f"rollout_rmse_{channel}{horizon}"]
            assert told["horizon_s"] == float(horizon.strip("_s") or 10.0)
            want = rolled(log, found.baseline["T_L"].mean, found.baseline["K_L"].mean, channel, told["horizon_s"])
            # fitted to four fifths of the rows, tested on the last: within a tenth
            assert told["before"] == pytest.approx(want, rel=0.1), (channel, horizon)
        whole = metrics[f"rollout_rmse_{channel}_whole"]
        assert whole["horizon_s"] is None
        usual = metrics[f"rollout_rmse_{channel}"]
        assert usual["before"] == pytest.approx(answer["gap"]["rollout"][f"rmse_{channel}"], rel=0.1)
    assert answer["shrinkage"]["horizon_s"] == metrics[answer["shrinkage"]["metric"]]["horizon_s"]


@pytest.mark.slow
def test_sentences_and_page_name_it(late: tuple[Log, Diagnosis]) -> None:
    _, found = late
    told = str(found)
    assert re.search(r"Gap of the baseline simulator, in rollouts of 10 s: acceleration error", told)
    assert re.search(r"In simulations of 10 s from the logged commands, .* the error in (accel|speed)", told)
    assert "over the drive" not in told
    page = report_html(found)
    for label in ("acceleration, 10 s [m/s²]", "acceleration, whole drive [m/s²]", "speed, 10 s [m/s]"):
        assert page.count(label) == 1


@pytest.mark.slow
def test_stretches_shorter_than_10_s_are_not_called_10_s() -> None:
    """Between overrides every 8 s: the sentence said 6 s, the page's table and its picture 10 s."""
    overrides = [(8.0 + 9 * k, 10.0 + 9 * k) for k in range(7)]
    log = taken_over(seconds=70.0, overrides=overrides, rng=np.random.default_rng(1), delay_s=0.3)
    found = avtorch.diagnose(log, effects=["dead_time"], pairs=False)
    assert "in rollouts of 6 s" in str(found)
    page = report_html(found)
    for label in ("acceleration, 6 s [m/s²]", "speed, 6 s [m/s]", "speed, 2 s [m/s]"):
        assert page.count(label) == 1
    # bands of residuals are by blocks of 10 s, whatever the rollouts
    assert "10 s" not in page.replace("by blocks of 10 s", "")
    figure, axes = plt.subplots()
    labels = [label.get_text() for label in shrinkage(axes, found, "speed").get_xticklabels()]
    plt.close(figure)
    assert labels == ["0.5 s", "2 s", "6 s", "whole drive"]
