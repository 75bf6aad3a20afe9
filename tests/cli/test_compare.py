"""`avtorch compare`: its output and files, and one line for input that it cannot use."""

import json
from pathlib import Path

import pytest

from avtorch.cli import main
from avtorch.gap import plant
from tests.gap.records import log_of


@pytest.mark.slow
def test_it_says_and_writes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = tmp_path / "one.csv", tmp_path / "two.csv"
    log_of(plant(T_L=0.3, K_L=1.0), seconds=60.0).write(one)
    log_of(plant(T_L=0.6, K_L=0.7), seconds=60.0).write(two)
    assert main(["compare", str(one), str(two), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "has changed" in said
    assert "lag T_L [s]" in said
    told = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert told["schema"] == "avtorch.comparison/1"
    assert told["changed"] is True
    assert main(["compare", str(one), str(one), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["changed"] is False


def test_what_it_cannot_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = tmp_path / "one.csv"
    log_of(seconds=60.0).write(one)
    for arguments, told in (
        ([str(one), str(tmp_path / "none.csv")], "none.csv"),
        ([str(one), str(one), "--baseline", "no_such=1"], "--baseline"),
        ([str(one), str(one), "--baseline-after", "dead_time=0.1"], "--baseline-after"),
    ):
        assert main(["compare", *arguments]) == 2
        error = capsys.readouterr().err
        assert told in error
        assert error.count("\n") == 1
