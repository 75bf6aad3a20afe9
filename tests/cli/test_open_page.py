"""`--open` shows the page that was written, and says where it is on a machine without a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import pytest

from avtorch import Leader, simulate
from avtorch.cli import main
from avtorch.cli.browser import show
from avtorch.cli.talk import Talk
from avtorch.gap import DeadTime, plant


def test_the_report_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    late = plant([DeadTime(0.4)], sigma=0.0)
    simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log().write(tmp_path / "drive.csv")
    out = tmp_path / "out"
    options = ["--effects", "dead_time", "--no-pairs", "--posterior", "laplace", "--quiet", "--open"]
    assert main(["diagnose", str(tmp_path / "drive.csv"), "--out", str(out), *options]) == 0
    (address,) = opened
    assert address == (out / "report.html").resolve().as_uri()
    assert (out / "report.html").is_file()


def test_without_a_browser_the_page_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    show(tmp_path / "fleet.html", Talk(json=False, quiet=False))
    assert capsys.readouterr().out == f"No browser was found to open {tmp_path / 'fleet.html'}\n"
