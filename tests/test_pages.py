"""The pages: their links lead somewhere; those on commands: their code runs, their commands and options exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from avtorch.cli import main

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = ("diagnosis.md", "compare.md", "fleet.md", "followers.md", "paper.md", "watch.md")
ALL = [DOCS.parent / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("effects/*.md"))]
# with tests of their own: tests/gap/simulator/test_own_effect_page.py, tests/test_gallery.py, tests/test_tutorial.py
ELSEWHERE = ("gallery.md", "own-effect.md", "tutorial.md")
CODE = [p.name for p in ALL[1:] if "```python" in p.read_text(encoding="utf-8") and p.name not in ELSEWHERE]
SLOW = ("coming-from.md", "compare.md", "diagnosis.md", "fleet.md", "fmu.md")
SLOW += ("followers.md", "pedals.md", "simulators.md")
COMMANDS = {"diagnosis.md": "diagnose", "followers.md": "diagnose"}


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


@pytest.mark.parametrize("page", [pytest.param(p, marks=pytest.mark.slow if p in SLOW else []) for p in CODE])
def test_code_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    found = blocks(page, "python")
    assert found
    for block in found:
        exec(compile(block, page, "exec", dont_inherit=True), names)


@pytest.mark.parametrize("page", PAGES)
def test_options_exist(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = re.sub(r"`python -m benchmarks[^`]*`", "", (DOCS / page).read_text(encoding="utf-8"))  # options of their own
    assert main([COMMANDS.get(page, page.removesuffix(".md")), "--help"]) == 0
    known = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))
    assert set(re.findall(r"(?<!-)--[a-z][a-z-]*", text)) <= known


@pytest.mark.parametrize("page", ALL, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """As a code host follows them; what the built site makes of them is checked when it is built."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    for target, mark in re.findall(r"\]\(([^)#:]*)(#[^)]*)?\)", text):
        other = page.parent / target if target else page
        assert other.exists(), target
        titles = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.M) if mark else []
        assert not mark or mark[1:] in [re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles], mark


@pytest.mark.parametrize("page", ALL, ids=lambda page: page.name)
def test_tests_that_are_named_exist(page: Path) -> None:
    """Every promise names a test that enforces it."""
    named = re.findall(r"\b(tests/[\w/]+\.py)(?:::(\w+))?", page.read_text(encoding="utf-8"))
    assert named or page.name != "trust.md"
    for path, name in named:
        there = ast.parse((DOCS.parent / path).read_text(encoding="utf-8")).body
        assert not name or name in [x.name for x in there if isinstance(x, ast.FunctionDef)], f"{path}::{name}"


def test_reference_names_only_what_exists() -> None:
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| \[?`([^`]+)`", text, re.M)
    assert folders
    assert not [folder for folder in folders if not (DOCS.parent / folder).is_dir()]
