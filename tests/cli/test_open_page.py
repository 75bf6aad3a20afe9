"""`--open` shows the page that was written, and says where it is on a machine without a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import pytest

from avtorch import Leader, simulate
from avtorch.cli import main
from avtorch.cli.talk import Talk
from avtorch.gap import DeadTime, plant


@pytest.mark.slow
def test_the_report_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    late = plant([DeadTime(0.4)], sigma=0.0)
    simulate(Leader.default(start=50.0, duration=14.0, dt=0.1), plant=late).log().write(tmp_path / "drive.csv")
    out = tmp_path / "out"
    options = ["--effects", "dead_time", "--no-pairs", "--posterior", "laplace", "--quiet", "--open"]
    assert main(["diagnose", str(tmp_path / "drive.csv"), "--out", str(out), *options]) == 0
    (address,) = opened
    assert address == (out / "report.html").absolute().as_uri()
    assert (out / "report.html").is_file()


LINES = {
    "estimates.html": ["estimate", "drive.csv", "--estimator", "map"],
    "run.html": ["run", "--duration", "4", "--change-at", "2", "--strategy", "none"],
    "comparison.html": ["compare", "drive.csv", "drive.csv", "--baseline", "T_L=0.4"],
}


@pytest.mark.slow
@pytest.mark.parametrize("page", LINES)
def test_the_page_of_each_command_is_opened_and_replaced(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second answer's page names its own command; nothing of the first one's stays."""
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: not opened.append(address))
    monkeypatch.chdir(tmp_path)
    simulate(Leader.default(start=30.0, duration=60.0, dt=0.1)).log().write("drive.csv")
    pages = []
    for more in (["--open"], ["--quiet", "--open"]):
        assert main([*LINES[page], "--out", "out", *more]) == 0
        pages.append((tmp_path / "out" / page).read_text(encoding="utf-8"))
    assert opened == 2 * [(tmp_path / "out" / page).absolute().as_uri()]
    assert "--quiet" in pages[1]
    assert "--quiet" not in pages[0]
    assert [p.name for p in (tmp_path / "out").glob("*.html")] == [page]


def test_a_page_needs_a_folder(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["compare", "before.csv", "after.csv", "--open"]) == 2
    assert capsys.readouterr().err == "avtorch: --open: found without --out; needs a folder for the page\n"


def test_without_a_browser_the_page_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    Talk(json=False, quiet=False).show(tmp_path / "fleet.html")
    assert capsys.readouterr().out == f"No browser was found to open {tmp_path / 'fleet.html'}\n"
