"""`avtorch diagnose --follower`: an answer with its conditions, and options that have no meaning."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from avtorch.cli import main
from tests.follower.loops import CTG, followed_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("follower") / "follower.csv"
    followed_log("constant_time_gap", CTG, seconds=90, rng=np.random.default_rng(2)).write(path)
    return path


@pytest.mark.slow
def test_answer_and_page(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "manoeuvre.csv").write_text("of an earlier diagnosis\n", encoding="utf-8")
    assert main(["diagnose", str(log), "--follower", "--effects", "aerodynamic_drag", "--out", str(out)]) == 0
    answer = json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert answer["schema"] == "avtorch.diagnosis/2"
    assert answer["follower"]["parameters"]["headway_s"]["mean"] == pytest.approx(1.65, abs=0.1)
    said = capsys.readouterr().out
    assert "headway" in said
    assert "P(string stable)" in said
    assert said.startswith("Assuming a constant time gap")
    assert set(answer["files"]) == {p.name for p in out.glob("[!.]*")} - {"diagnosis.json"}, "all of one set"
    assert not (out / "manoeuvre.csv").exists()
    assert "The loop" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "needs"),
    [
        (["--follower", "--budget", "5"], "--budget: has no meaning with --follower"),
        (["--follower", "--vehicle", "2"], "vehicle 2 has no meaning"),
        (["--follower", "--event", "2"], "event 2 has no meaning"),
        (["--follower", "--no-pairs"], "--no-pairs: has no meaning with --follower"),
        (["--follower", "--accel-kind", "specific-force"], "--accel-kind: has no meaning with --follower"),
        (["--follower", "--posterior", "laplace"], "--posterior: has no meaning with --follower"),
        (["--follower", "--road", "500"], "--road: has no meaning with --follower"),
        (["--event", "2"], "--event: has a meaning with --follower only"),
        (["--vehicle", "2"], "--vehicle: has a meaning with --follower only"),
        ([], "`--follower` diagnoses"),
    ],
)
def test_impossible_options_are_refused(
    log: Path, tmp_path: Path, refused: Callable[[list[str]], str], options: list[str], needs: str
) -> None:
    assert needs in refused(["diagnose", str(log), *options, "--out", str(tmp_path / "out")])
