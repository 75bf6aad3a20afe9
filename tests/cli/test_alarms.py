"""Alarms come from the answer of `avtorch estimate` on the same log, and from nothing else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch import Log
from avtorch.cli.diagnose import read_alarms
from avtorch.errors import InputError
from avtorch.gap.result.traces import Alarm

TIME = 1000.0 + 0.05 * np.arange(200)
LOG = Log.from_arrays(name="drive.csv", time=TIME, accel_cmd=np.sin(TIME), speed=10 + np.cos(TIME))


def answer(**more: Any) -> dict[str, Any]:
    alerts = ([], ["change"], ["change", "stability"], [], ["change"])
    windows = [{"end_s": 1002.0 + 2.0 * k, "alerts": names} for k, names in enumerate(alerts)]
    return {
        "schema": "avtorch.estimates/1",
        "epoch_s": 1000.0,
        "windows": windows,
        "quality": {"rows": 200},
    } | more


def written(tmp_path: Path, content: object) -> Path:
    path = tmp_path / "estimates.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def test_an_alarm_that_goes_on_is_one_and_its_time_is_from_the_logs_start(tmp_path: Path) -> None:
    found = read_alarms([written(tmp_path, answer())], [LOG])
    assert found == (Alarm(4.0, "change"), Alarm(6.0, "stability"), Alarm(10.0, "change"))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (
            answer(quality={"rows": 201}),
            "of a log of 201 rows .* needs the estimates of drive.csv, 200 rows from 1000 s",
        ),
        (answer(epoch_s=0.0), "begins at 0 s"),
        (answer(schema="avtorch.run/1"), "found 'avtorch.run/1' as its schema"),
        (answer(windows=[{}]), "is damaged"),
        ([], "is damaged"),
        ("{", "is damaged"),
    ],
)
def test_another_answer_is_one_clear_error(tmp_path: Path, content: object, told: str) -> None:
    with pytest.raises(InputError, match=told) as fault:
        read_alarms([written(tmp_path, content)], [LOG])
    assert "estimates.json" in str(fault.value)


def test_each_log_needs_its_own(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--estimates: found 1 for 2 logs"):
        read_alarms([written(tmp_path, answer())], [LOG, LOG])
