"""Every rollout error is that of rollouts of the length in its label: computed here again from the label alone."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import avtorch
from avtorch.gap import DeadTime, plant
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.io import Log
from avtorch.report import report_html
from tests.gap.records import log_of

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
def test_what_was_held_out_is_over_its_own(late: tuple[Log, Diagnosis]) -> None:
    _, found = late
    told = found.to_dict()["shrinkage"]
    for channel in ("accel", "speed"):
        metric = told["by_metric"][f"rollout_rmse_{channel}"]
        assert 4.0 <= metric["horizon_s"] <= 10.0
        # of free runs that begin with the block instead of at every row: the same errors, to a third
        assert metric["before"] == pytest.approx(found.to_dict()["gap"]["rollout"][f"rmse_{channel}"], rel=0.35)
    assert told["horizon_s"] == told["by_metric"][told["metric"]]["horizon_s"]


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
