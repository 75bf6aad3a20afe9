"""The pages: their links lead somewhere, their code runs, and the commands and options that they name exist."""

from __future__ import annotations

import ast
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from avtorch.cli import main

ROOT = Path(__file__).resolve().parents[1]
DOCS, BENCHMARKS = ROOT / "docs", ROOT / "benchmarks"
OF_DOCS = [*sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("effects/*.md"))]
ALL = [ROOT / "README.md", ROOT / "CHANGELOG.md", *OF_DOCS, *sorted(BENCHMARKS.rglob("*.md"))]
# with tests of their own: tests/gap/simulator/test_own_effect.py, tests/test_gallery.py, tests/test_tutorial.py
ELSEWHERE = ("gallery.md", "own-effect.md", "tutorial.md")
CODE = [p.name for p in OF_DOCS if "```python" in p.read_text(encoding="utf-8") and p.name not in ELSEWHERE]
QUICK = ("paper.md",)
READ, ACT = ("check", "estimate", "diagnose", "compare", "check-simulator"), ("fleet", "watch", "stability", "run")
COMMANDS = {
    "../README.md": (*READ, *ACT, "validate", "paper"),
    "diagnosis.md": ("diagnose",),
    "estimation.md": ("estimate", "stability"),
    "fleet.md": ("fleet", "watch", "check"),
    "logs.md": ("check", "estimate", "diagnose"),
    "paper.md": ("paper",),
    "simulators.md": ("diagnose", "compare", "check-simulator"),
}


def named(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: str, language: str) -> list[str]:
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.S | re.M)


@pytest.mark.parametrize("page", [pytest.param(p, marks=[] if p in QUICK else pytest.mark.slow) for p in CODE])
def test_code_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    found = blocks(page, "python")
    assert found
    for block in found:
        exec(compile(block, page, "exec", dont_inherit=True), names)


@pytest.mark.parametrize("page", COMMANDS)
def test_options_exist(page: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = re.sub(r"`python -m benchmarks[^`]*`", "", (DOCS / page).read_text(encoding="utf-8"))  # options of their own
    for command in COMMANDS[page]:
        assert main([command, "--help"]) == 0
    known = set(re.findall(r"--[a-z][a-z-]*", capsys.readouterr().out))
    assert set(re.findall(r"(?<!-)--[a-z][a-z-]*", text)) <= known


@pytest.mark.parametrize("page", ALL, ids=named)
def test_benchmarks_that_are_named_exist(page: Path) -> None:
    """Each is a module of `benchmarks`, and each of its options stands in its source."""
    for module, options in re.findall(r"python -m (benchmarks[\w.]*)([^`\n]*)", page.read_text(encoding="utf-8")):
        spec = find_spec(module)
        assert spec is not None, module
        assert spec.origin is not None
        path = Path(spec.origin)
        source = (path.with_name("__main__.py") if path.name == "__init__.py" else path).read_text(encoding="utf-8")
        for option in re.findall(r"--([a-z][a-z-]*)", options):
            assert re.search(rf"[\"'](?:--)?{option}[\"']", source) or f"{option}=" in source, f"{module} --{option}"


@pytest.mark.parametrize("page", ALL, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    """As a code host follows them; what the built site makes of them is checked when it is built."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.S | re.M)
    for target, mark in re.findall(r"\]\(([^)#:]*)(#[^)]*)?\)", text):
        other = page.parent / target if target else page
        assert other.exists(), target
        titles = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.M) if mark else []
        assert not mark or mark[1:] in [re.sub(r"[^\w\- ]", "", t.lower()).replace(" ", "-") for t in titles], mark


@pytest.mark.parametrize("page", ALL, ids=named)
def test_tests_that_are_named_exist(page: Path) -> None:
    """Every promise names a test that enforces it."""
    found = re.findall(r"\b(tests/[\w/]+\.py)(?:::(\w+))?", page.read_text(encoding="utf-8"))
    assert found or page.name != "trust.md"
    for path, name in found:
        there = ast.parse((ROOT / path).read_text(encoding="utf-8")).body
        assert not name or name in [x.name for x in there if isinstance(x, ast.FunctionDef)], f"{path}::{name}"


def test_reference_names_only_what_exists() -> None:
    text = (DOCS / "reference.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| \[?`([^`]+)`", text, re.M)
    assert folders
    assert not [folder for folder in folders if not (ROOT / folder).is_dir()]
    for name, path in re.findall(r"`(\w+)` (?:and `\w+` )?in \[`[^`]+`\]\(\.\./([^)]+)\)", text):
        source = (ROOT / path).read_text(encoding="utf-8")
        assert re.search(rf"\b{name}\b", source), f"{path}: {name}"


def test_the_pages_can_be_read_in_an_afternoon() -> None:
    def words(pages: list[Path]) -> int:
        return sum(len(page.read_text(encoding="utf-8").split()) for page in pages)

    assert words(OF_DOCS) <= 30_000
    assert words([ROOT / "README.md"]) <= 700
