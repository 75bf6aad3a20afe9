"""A diagnosis with every section of the page, made once."""

from __future__ import annotations

from dataclasses import replace

import pytest

import avtorch
from avtorch.experiment import Experiment, Information, library
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.remedy import setting_for
from avtorch.report.diagnosis import report_html
from benchmarks.blindtest import draw_case

HOSTILE = '<script>alert(1)</script>"&{{ 7 * 7 }}.csv'


@pytest.fixture(scope="session")
def ahead() -> Experiment:
    separated = ("sensor_bias", "constant_resistance")
    return Experiment(library()[0], separated, Information(0.6, 0.95, 4.0), entropy=0.69, every={}, why="They differ.")


@pytest.fixture(scope="session")
def found(ahead: Experiment) -> Diagnosis:
    case = draw_case(
        0,
        20,
        mix={"none": 0.0, "single": 1.0, "pair": 0.0, "outside": 0.0},
        effects=["sensor_bias"],
        tiers=["easy"],
        seconds=60.0,
        manoeuvre="steps",
    )
    log = replace(case.log(), name=HOSTILE)
    told = avtorch.diagnose(log, effects=["sensor_bias", "constant_resistance"], pairs=False)
    setting = setting_for(told, log.accel_cmd)
    return replace(told, setting=None if setting is None else setting.to_dict(), next_experiment=ahead.to_dict())


@pytest.fixture(scope="session")
def page_text(found: Diagnosis, ahead: Experiment) -> str:
    return report_html(found, experiment=ahead, quality=["2 rows masked"], sections={"The loop": ["It is closed."]})
