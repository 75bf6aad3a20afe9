"""The pages on diagnosis, blind test, comparisons and followers: their code runs, their commands and options exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from avtorch.cli import main

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("diagnosis.md", "blindtest.md", "compare.md", "followers.md")
COMMANDS = {"diagnosis.md": "diagnose", "followers.md": "diagnose"}


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_code_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    found = blocks(page, "python")
    assert found
    for block in found:
        exec(compile(block, page, "exec", dont_inherit=True), names)


@pytest.mark.parametrize("page", PAGES)
def test_options_exist(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    assert main([COMMANDS.get(page, page.removesuffix(".md")), "--help"]) == 0
    known = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))
    assert set(re.findall(r"(?<!-)--[a-z][a-z-]*", text)) <= known


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    text = (DOCS / page).read_text(encoding="utf-8")
    for target, mark in re.findall(r"\]\(([^)#:]*)(#[^)]*)?\)", text):
        other = DOCS / (target or page)
        assert other.exists(), target
        titles = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.M)
        assert not mark or mark[1:] in [t.lower().replace(" ", "-") for t in titles], mark
