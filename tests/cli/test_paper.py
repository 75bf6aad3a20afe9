"""`avtorch paper`: its files, its answer, its text, and one line for input that it cannot use."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from avtorch.cli import main


@pytest.mark.slow
def test_one_experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.delenv("AVTORCH_DATA", raising=False)
    out = tmp_path / "out"
    arguments = ["paper", "gains", "--seeds", "2", "--seed", "3", "--out", str(out)]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "US06, the embedded drive cycle" in told
    assert "Not reproduced:" in told
    assert {p.name for p in out.glob("[!.]*")} == {"gains.png", "paper.json"}
    answer = json.loads((out / "paper.json").read_text(encoding="utf-8"))
    assert (answer["schema"], answer["seed"], answer["seeds"]) == ("avtorch.paper/1", 3, 2)
    assert {row["name"] for row in answer["rows"]} == {"gains"}
    assert main([*arguments, "--json"]) == 0
    assert set(answer.pop("files")) == {"gains.png"}
    assert json.loads(capsys.readouterr().out) == answer


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (["gain"], "gain"),
        (["--seeds", "1"], "--seeds: found 1, needs 2 or more"),
        (["--seeds", "2.5"], "needs a whole number"),
        (["--seed", "-1"], "--seed: found -1"),
        (["--data", "nowhere"], "data: nowhere is not a folder"),
    ],
)
def test_bad_arguments(arguments: list[str], fault: str, tmp_path: Path, refused: Callable[[list[str]], str]) -> None:
    assert fault in refused(["paper", *arguments, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
