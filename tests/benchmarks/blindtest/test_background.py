"""Effects in front of recordings: controls first, each once; what was answered stays; what cannot be is left out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest import IN_FRONT, put_in_front
from benchmarks.blindtest.background import SIZES, run_background
from benchmarks.blindtest.reply import reply
from benchmarks.blindtest.rivals import random_guess

T_L, K_L = 0.4, 0.9


def recording(seed: int, *, rows: int = 600, name: str = "lap") -> Log:
    rng, time = np.random.default_rng(seed), np.arange(rows) / 20
    command = np.sin(0.5 * time) + 0.3 * rng.standard_normal(rows).cumsum() / 30
    return Log.from_arrays(
        name=name, time=time, accel_cmd=command, accel=0.9 * command, speed=15 + np.cumsum(command) / 20
    )


class Ears:
    """Names `sensor_bias` with the mean of `accel` on top of 0.9 of the command; remembers the logs."""

    def __init__(self) -> None:
        self.logs: list[Log] = []

    def __call__(self, log: Log) -> dict[str, Any]:
        self.logs.append(log)
        assert log.accel is not None
        assert log.accel_cmd is not None
        off = float(np.mean(log.accel - 0.9 * log.accel_cmd))
        fit = {"T_L": (T_L, 0.01), "K_L": (K_L, 0.01)}
        if abs(off) < 1e-6:
            return reply(log, {"none": 1.0}, why="nothing", baseline=fit)
        told = {"sensor_bias": {"bias_mps2": (off, 0.01)}}
        return reply(log, {"sensor_bias": 1.0}, why="an offset", baseline=fit, parameters=told)


def run(out: Path, logs: list[Log], **more: Any) -> dict[str, Any]:
    given = {"answerer": Ears(), "effects": ["dead_time", "sensor_bias", "aerodynamic_drag"], "sizes": (0.5, 1.0)}
    return run_background(logs, 7, out, **given | more)


def test_controls_come_first_and_answers_are_held_against_them(tmp_path: Path) -> None:
    ears, steps = Ears(), []
    logs = [recording(1), recording(2, name="lap2")]
    found = run(tmp_path, logs, answerer=ears, progress=lambda *step: steps.append(step))
    assert len(ears.logs) == 2 + 2 * 3 * 2
    assert [log.name for log in ears.logs] == [f"case_{i:05d}" for i in range(14)]
    for shown, log in zip(ears.logs[:2], logs, strict=True):
        np.testing.assert_array_equal(shown.accel_cmd, log.accel_cmd)
    assert steps[0] == (0, 14)
    assert steps[-1] == (14, 14)
    assert found == json.loads((tmp_path / "background.json").read_text(encoding="utf-8"))
    assert [one["names"] for one in found["backgrounds"]] == [["none"], ["none"]]
    assert [(one["T_L"], one["K_L"]) for one in found["backgrounds"]] == [(T_L, K_L)] * 2
    cells = {(c["effect"], c["size"]): c for c in found["table"]}
    assert len(cells) == 6
    bias = cells["sensor_bias", 0.5]
    assert (bias["trials"], bias["held"], bias["sized"], bias["size_right"], bias["extra"]) == (2, 2, 2, 2, 0)
    drag = cells["aerodynamic_drag", 1.0]
    assert (drag["held"], drag["extra"]) == (0, 2)  # a rewritten command looks like an offset to these ears
    assert found["totals"]["trials"] == 12
    assert found["failed"] == 0
    # a force takes the lag and gain of the control's fit, and its draws from the seed
    truth = json.loads((tmp_path / "truth" / "case_00006.json").read_text(encoding="utf-8"))
    assert (truth["effect"], truth["size"], truth["baseline"]) == ("aerodynamic_drag", 0.5, {"T_L": T_L, "K_L": K_L})
    expected, put_in = put_in_front(logs[0], "aerodynamic_drag", T_L=T_L, K_L=K_L, size=0.5)
    np.testing.assert_array_equal(ears.logs[6].accel_cmd, expected.accel_cmd)
    assert truth["put_in"] == put_in


def test_only_missing_answers_are_asked_for(tmp_path: Path) -> None:
    logs = [recording(1), recording(2, name="lap2")]
    found = run(tmp_path, logs)
    for index in (0, 5):
        (tmp_path / "answers" / "avtorch" / f"case_{index:05d}.json").unlink()
    ears = Ears()
    # a recording may have moved
    again = run(tmp_path, [replace(log, name=f"elsewhere/{log.name}") for log in logs], answerer=ears)
    assert [log.name for log in ears.logs] == ["case_00000", "case_00005"]
    assert again["totals"] == found["totals"]
    for change in ({"sizes": (0.5,)}, {"effects": ["dead_time"]}):
        with pytest.raises(InputError, match="needs the same, or another folder"):
            run(tmp_path, logs, **change)
    with pytest.raises(InputError, match="holds a trial with background"):
        run(tmp_path, logs[:1])


def test_what_a_log_cannot_show_is_left_out(tmp_path: Path) -> None:
    log = recording(3)
    assert log.accel_cmd is not None
    never_brakes = replace(log, accel_cmd=np.abs(log.accel_cmd) + 0.1, accel=None, name="no accel")

    def knows_nothing(log: Log) -> dict[str, Any]:
        return reply(log, {"unknown": 1.0}, why="who knows")

    found = run(tmp_path, [never_brakes], answerer=knows_nothing, effects=None, sizes=(1.0,))
    left_out = {one["effect"]: one["why"] for one in found["skipped"]}
    sensors = {"sensor_bias", "sensor_scale", "sensor_lag", "outliers"}
    assert set(left_out) == sensors | {"brake_throttle_asymmetry", "low_speed_creep"}
    assert "has no accel" in left_out["sensor_bias"]
    assert "nothing changes" in left_out["brake_throttle_asymmetry"]
    assert "nothing changes" in left_out["low_speed_creep"]  # never below 3 m/s
    assert [cell["effect"] for cell in found["table"]] == [effect for effect in IN_FRONT if effect not in left_out]
    assert found["totals"]["shares"]["nothing_named"] == 1.0


def test_effects_with_chance_are_drawn_as_often_as_asked(tmp_path: Path) -> None:
    ears = Ears()
    found = run(tmp_path, [recording(1)], answerer=ears, effects=["dead_time", "gain_change"], sizes=(1.0,), draws=3)
    counts = {cell["effect"]: cell["trials"] for cell in found["table"]}
    assert counts == {"dead_time": 1, "gain_change": 3}  # a dead time is the same whenever it is drawn
    moments = [one["put_in"]["change_s"] for one in found["trials"] if one["effect"] == "gain_change"]
    assert len(set(moments)) == 3
    assert len(ears.logs) == 5
    with pytest.raises(InputError, match="draws"):
        run(tmp_path, [recording(1)], effects=["dead_time", "gain_change"], sizes=(1.0,), draws=2)
    # one draw is the first of three
    alone = run(tmp_path / "one", [recording(1)], effects=["gain_change"], sizes=(1.0,))
    assert alone["trials"][0]["put_in"]["change_s"] == moments[0]


@pytest.mark.parametrize("fails", ["control", "injected"])
def test_who_fails_has_not_answered(fails: str, tmp_path: Path) -> None:
    ears = Ears()

    def sometimes(log: Log) -> dict[str, Any]:
        if (log.name == "case_00000") == (fails == "control"):
            raise ValueError("out of ideas")
        return ears(log)

    found = run(tmp_path, [recording(1)], answerer=sometimes)
    if fails == "control":
        assert found["totals"]["trials"] == 0
        assert found["failed"] == 1
        assert found["backgrounds"][0]["names"] is None
        assert "no fit to the untouched log (ValueError: out of ideas)" in found["notes"][0]
    else:
        assert found["totals"]["failed"] == found["totals"]["trials"] == found["failed"] == 6
        assert found["totals"]["held"] == found["totals"]["nothing_named"] == 0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"logs": []}, "logs: found none"),
        ({"logs": [recording(1), recording(1, name="copy")]}, "copy: holds the same drive as lap"),
        ({"seed": -1}, "seed: found -1"),
        ({"workers": 0}, "workers: found 0"),
        ({"draws": 0}, "draws: found 0"),
        ({"effects": ["wings"]}, "effects: found wings"),
        ({"effects": ["gust", "gust"]}, "effects: found gust, gust"),
        ({"sizes": (0.0,)}, "sizes: found 0"),
        ({"sizes": ()}, "sizes: found none"),
    ],
)
def test_bad_arguments_are_refused(change: dict, told: str, tmp_path: Path) -> None:
    given = {"logs": [recording(1)], "seed": 0, "out": tmp_path / "out", "answerer": Ears()} | change
    with pytest.raises(InputError, match=told):
        run_background(**given)
    assert not (tmp_path / "out").exists()
    assert SIZES == (0.5, 0.8, 1.25)


@pytest.mark.slow
def test_two_processes_say_the_same_as_one(tmp_path: Path) -> None:
    logs = [recording(1), recording(2, name="lap2")]
    one, two = (
        run(tmp_path / str(workers), logs, answerer=random_guess, name="guess", workers=workers) for workers in (1, 2)
    )
    times = ("seconds_per_log", "cpu_seconds_per_log")
    assert {k: v for k, v in one.items() if k not in times} == {k: v for k, v in two.items() if k not in times}
