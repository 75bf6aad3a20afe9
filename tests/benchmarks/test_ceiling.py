"""The ceiling counts what was told and what was found, and tells an easy case's cause as likely."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.ceiling import case_figures, collect, row


def _cause(name: str, probability: float, *, named: bool) -> dict[str, Any]:
    return {"name": name, "named": named, "probability": probability, "nats": 1.0}


def test_causes_are_counted_by_name_and_by_likelihood() -> None:
    one = {
        "names": ["dead_time", "gust", "saturation"],
        "causes": [_cause("dead_time", 0.9, named=True), _cause("saturation", 0.2, named=True)],
        "wrong": [],
        "truth_preferred": True,
        "selection_preferred": False,
    }
    other = {
        "names": ["backlash"],
        "causes": [_cause("backlash", 0.7, named=False)],
        "wrong": ["road_grade"],
        "truth_preferred": False,
        "selection_preferred": False,
    }
    found = row([one, other])
    assert (found["causes"], found["by_chance"]) == (3, 1)
    assert (found["named"], found["likely_once_told"], found["of_these_named"]) == (2, 2, 1)
    assert (found["wrong_names"], found["blocks_prefer_the_truth"]) == (1, 1)


@pytest.mark.slow
def test_a_plain_cause_is_found_and_told() -> None:
    # brakes of another gain, 100 nats: the first such case of a minute of this seed
    case = case_figures(3, 777001, "single", "ordinary")
    assert case["names"] == ["brake_throttle_asymmetry"]
    (cause,) = case["causes"]
    assert cause["nats"] > 50
    assert cause["probability"] > 0.5
    assert cause["named"]
    assert not case["wrong"]
    assert case["nats_of_the_truth"] == pytest.approx(0.0, abs=0.1)  # the same set, fitted twice


def test_kept_cases_are_not_drawn_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[int] = []

    def figures(index: int, *_: object) -> dict[str, Any]:
        drawn.append(index)
        return {"case": index}

    monkeypatch.setattr("benchmarks.ceiling.case_figures", figures)
    for cases in (2, 3):
        collect(tmp_path, 1, cases, "pair", "ideal")
    assert drawn == [0, 1, 2]
    (path,) = tmp_path.iterdir()
    assert len(path.read_text(encoding="utf-8").splitlines()) == 3
