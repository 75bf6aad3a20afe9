"""A trial keeps what was answered, does only what is missing, and scores all who answered alike."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from avtorch.errors import InputError
from avtorch.io import Log
from benchmarks.blindtest.reply import reply
from benchmarks.blindtest.rivals import random_guess
from benchmarks.blindtest.trial import run_trial

SHORT = {"seconds": 60.0, "tiers": ("easy",)}
KEYS = {
    *("cases", "seed", "top1", "alias_set", "false_alarm", "unknown_auroc", "unknown_fpr95"),
    *("unknown_confidently_blamed", "ece", "brier", "macro_f1", "pairs_exact", "pairs_jaccard", "closed_error"),
    *("placebo_closed", "onset_error_s", "seconds_per_case", "baselines", "confusion"),
}


class Asked:
    """Answers `none`, and records the logs that it was given."""

    def __init__(self) -> None:
        self.logs: list[Log] = []

    def __call__(self, log: Log) -> dict[str, Any]:
        self.logs.append(log)
        return reply(log, {"none": 1.0}, why="always")


@pytest.mark.slow
def test_answers_are_kept_and_only_missing_ones_are_asked_for(tmp_path: Path) -> None:
    first, steps = Asked(), []
    found = run_trial(6, 4, tmp_path, answerers={"says_none": first}, progress=lambda *s: steps.append(s), **SHORT)
    assert [log.name for log in first.logs] == [f"case_{i:05d}" for i in range(6)]
    assert steps == [(i, 6) for i in range(7)]
    assert json.loads((tmp_path / "blindtest.json").read_text(encoding="utf-8")) == found
    assert found["schema"] == "avtorch.blindtest/1"
    assert found.keys() >= KEYS
    assert found["false_alarm"] in (0.0, None)
    assert found["baselines"] == {}

    again, guess = Asked(), {"random_guess": random_guess}
    (tmp_path / "answers" / "says_none" / "case_00003.json").unlink()
    more = run_trial(7, 4, tmp_path, answerers={"says_none": again, **guess}, **SHORT)
    assert [log.name for log in again.logs] == ["case_00003", "case_00006"]
    assert set(more["baselines"]) == {"random_guess"}
    assert KEYS - {"cases", "seed", "baselines"} <= more["baselines"]["random_guess"].keys()
    assert sum(sum(row.values()) for row in more["confusion"].values()) == 7
    # truths are stored apart from the input of an answerer
    assert not {"truth", "logs"} & {p.name for p in (tmp_path / "answers").rglob("*")}


@pytest.mark.slow
def test_several_causes_are_divided_alike_when_drawn_again(tmp_path: Path) -> None:
    options: dict[str, Any] = {"mix": {"several": 1.0}, "seconds": 30.0, "signals": ("speed",)}
    found = run_trial(1, 5, tmp_path, answerers={"says_none": Asked()}, **options)
    assert found["several"]["recall"] == 0.0
    assert found["counts"]["several"]["exact"] == 1
    truth = json.loads((tmp_path / "truth" / "case_00000.json").read_text(encoding="utf-8"))
    assert list(truth["budget"]["by_channel"]) == ["speed"]
    # the truth is compared with the kept one
    assert run_trial(1, 5, tmp_path, answerers={"other": Asked()}, **options)["failed"] == 0


def test_other_settings_need_another_folder(tmp_path: Path) -> None:
    run_trial(1, 4, tmp_path, answerers={"says_none": Asked()}, **SHORT)
    with pytest.raises(InputError, match="trial with seed 4; found 5"):
        run_trial(1, 5, tmp_path, answerers={"says_none": Asked()}, **SHORT)
    with pytest.raises(InputError, match="signals"):
        run_trial(1, 4, tmp_path, answerers={"says_none": Asked()}, signals=("speed",), **SHORT)
    # a vehicle that has changed makes another case of the same number
    truth = tmp_path / "truth" / "case_00000.json"
    truth.write_text(json.dumps(json.loads(truth.read_text(encoding="utf-8")) | {"visibility": 1.0}), encoding="utf-8")
    with pytest.raises(InputError, match="comes out otherwise"):
        run_trial(1, 4, tmp_path, answerers={"other": Asked()}, **SHORT)


@pytest.mark.slow
def test_who_fails_or_breaks_the_schema_has_not_answered(tmp_path: Path) -> None:
    def fails(log: Log) -> dict[str, Any]:
        raise ValueError("out of ideas")

    def breaks(log: Log) -> dict[str, Any]:
        answer = reply(log, {"none": 1.0}, why="half")
        answer["effects"][0]["probability"] = 0.5
        return answer

    def not_finite(log: Log) -> dict[str, Any]:
        return reply(log, {"none": 1.0}, why="nan") | {"onset_s": float("nan")}

    def no_budget(log: Log) -> dict[str, Any]:
        odd = {"parts": ["dead_time"], "chance": [], "unexplained": {"share": {"mean": 0.0}}}
        return reply(log, {"none": 1.0}, why="odd") | {"schema": "avtorch.diagnosis/2", "budget": odd}

    every = {"fails": fails, "breaks": breaks, "not_finite": not_finite, "no_budget": no_budget}
    found = run_trial(2, 4, tmp_path, answerers=every, **SHORT)
    assert found["failed"] == 2
    assert found["failures"] == ["ValueError: out of ideas"]
    assert {v for row in found["confusion"].values() for v in row} == {"failed"}
    assert "probabilities sum to 0.5" in found["baselines"]["breaks"]["failures"][0]
    assert found["baselines"]["not_finite"]["failed"] == 2
    assert found["baselines"]["no_budget"]["failed"] == 2
    assert "not of avtorch.diagnosis/1 or avtorch.diagnosis/2" in found["baselines"]["no_budget"]["failures"][0]


@pytest.mark.slow
def test_two_processes_say_the_same_as_one(tmp_path: Path) -> None:
    guess = {"random_guess": random_guess}
    one = run_trial(4, 4, tmp_path / "one", answerers=guess, signals=("accel",), **SHORT)
    two = run_trial(4, 4, tmp_path / "two", answerers=guess, workers=2, signals=("accel",), **SHORT)
    times = ("seconds_per_case", "cpu_seconds_per_case", "intervals")
    assert {k: v for k, v in two.items() if k not in times} == {k: v for k, v in one.items() if k not in times}


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"n": 0}, "n: found 0"),
        ({"workers": 0}, "workers: found 0"),
        ({"answerers": {}}, "answerers: found none"),
        ({"answerers": {"../up": random_guess}}, "answerers: found the name"),
        ({"signals": ("jerk",)}, "signals: found"),
    ],
)
def test_bad_arguments_are_refused(change: dict, told: str, tmp_path: Path) -> None:
    given = {"n": 1, "seed": 0, "out": tmp_path / "out", "answerers": {"guess": random_guess}} | change
    with pytest.raises(InputError, match=told):
        run_trial(**given)
    assert not (tmp_path / "out").exists()
