"""Every rollout error is that of rollouts of the length in its label: computed here again from the label alone."""

from __future__ import annotations

import re

import numpy as np
import pytest

import avtorch
from avtorch.gap import DeadTime, plant
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report.diagnosis import report_html
from tests.gap.records import log_of


@pytest.fixture(scope="module")
def late() -> Diagnosis:
    log = log_of(plant([DeadTime(0.3)], T_L=0.4, K_L=0.9), seconds=90.0)
    return avtorch.diagnose(log, effects=["dead_time"], pairs=False)


def rolled(found: Diagnosis, channel: str, horizon_s: float) -> float:
    """Root mean square of the simulator's errors in free runs: of a speed begun anew at the measured one."""
    assert found.traces is not None
    k = found.traces.channels.index(channel)
    error = (found.traces.measured - found.traces.before)[k]
    dt = float(found.traces.time[1] - found.traces.time[0])
    runs = np.split(error, np.arange(0, len(error), round(horizon_s / dt))[1:])
    if channel == "speed":
        runs = [run - run[: round(0.5 / dt)].mean() for run in runs]
    return float(np.sqrt(np.mean(np.concatenate(runs) ** 2)))


@pytest.mark.slow
def test_the_gap_is_over_the_horizon_that_it_names(late: Diagnosis) -> None:
    told = late.to_dict()["gap"]["rollout"]
    assert told["horizon_s"] == 10.0
    for channel in ("accel", "speed"):
        # the answer was taken at the mode of the lag, here it is at the mean
        assert told[f"rmse_{channel}"] == pytest.approx(rolled(late, channel, told["horizon_s"]), rel=0.02), channel


@pytest.mark.slow
def test_what_was_held_out_is_over_its_own(late: Diagnosis) -> None:
    found = late
    told = found.to_dict()["shrinkage"]
    for channel in ("accel", "speed"):
        metric = told["by_metric"][f"rollout_rmse_{channel}"]
        assert 4.0 <= metric["horizon_s"] <= 10.0
        # of free runs that begin with the blocks: the same errors, to a third
        assert metric["before"] == pytest.approx(found.to_dict()["gap"]["rollout"][f"rmse_{channel}"], rel=0.35)
    assert told["horizon_s"] == told["by_metric"][told["metric"]]["horizon_s"]


@pytest.mark.slow
def test_sentences_and_page_name_it(late: Diagnosis) -> None:
    found = late
    told = str(found)
    assert re.search(r"Gap of the baseline simulator, in rollouts of 10 s: acceleration error", told)
    assert re.search(r"In simulations of 10 s from the logged commands, .* the error in (accel|speed)", told)
    assert "over the drive" not in told
    page = report_html(found)
    for label in ("acceleration, 10 s [m/s²]", "speed, 10 s [m/s]"):
        assert page.count(label) == 1
