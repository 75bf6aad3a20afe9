"""The footer: how the page was made, as far as the caller knows."""

from __future__ import annotations

import hashlib
import platform
from pathlib import Path

import numpy as np
import pytest
import torch

import avtorch
from avtorch.cli.app import main
from avtorch.cli.arguments import COMMAND_LINE
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report import Origin
from avtorch.report.diagnosis import report_html
from tests.report.tree import read


def footer(text: str) -> dict[str, str]:
    """Its entries by their titles."""
    (foot,) = read(text).all("footer")
    words = [x.text() or next(x.all("code")).text() for x in foot.all("dt", "dd")]
    return dict(zip(words[::2], words[1::2], strict=True))


@pytest.mark.slow
def test_it_names_command_versions_and_hashes(found: Diagnosis, tmp_path: Path) -> None:
    log = tmp_path / "a <b>.csv"
    log.write_bytes(b"time,speed")
    command = "avtorch diagnose 'a <b>.csv' --out out"
    told = footer(report_html(found, origin=Origin.of(command, [log], {"seed": 0})))
    assert told["command"] == command
    assert told["SHA-256 of a <b>.csv"] == hashlib.sha256(b"time,speed").hexdigest()
    assert told["SHA-256 of the settings"] != Origin.of(settings={"seed": 1}).settings
    numbers = f"torch {torch.__version__}, numpy {np.__version__}, Python {platform.python_version()}"
    assert told["versions"] == f"avtorch {avtorch.__version__}, {numbers}"


@pytest.mark.slow
def test_it_leaves_out_what_the_caller_did_not_say(found: Diagnosis) -> None:
    assert list(footer(report_html(found))) == ["versions"]


def test_recordings_that_are_folders_and_logs_of_one_name(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "lap.csv").write_text(folder)
    logs = [tmp_path / "one" / "lap.csv", tmp_path / "two" / "lap.csv"]
    assert list(Origin.of(None, logs).files) == ["lap.csv", "lap.csv (2)"]
    assert list(Origin.of(None, [tmp_path / "one"]).files) == [str(Path("one", "lap.csv"))]


def test_the_command_line_is_quoted_and_known_only_within_a_command(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str | None] = []
    monkeypatch.setattr("avtorch.cli.app.app", lambda *_, **__: seen.append(COMMAND_LINE.get()))
    assert main(["diagnose", "my lap.csv"]) == 0
    assert seen == ["avtorch diagnose 'my lap.csv'"]
    assert COMMAND_LINE.get() is None
