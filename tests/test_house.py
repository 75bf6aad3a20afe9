"""Rules of the repository: the files that a newcomer reads first, and rules that a reviewer would otherwise check."""

from __future__ import annotations

import ast
import re
import tomllib
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "avtorch"
SOURCES = sorted(PACKAGE.rglob("*.py"))


def project() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", ["README.md", "CHANGELOG.md", "LICENSE", "Makefile", ".gitignore", ".ci/run"])
def test_files_a_newcomer_meets(name: str) -> None:
    assert (ROOT / name).read_text(encoding="utf-8").strip()


def test_ci_script_can_be_run() -> None:
    assert (ROOT / ".ci/run").stat().st_mode & 0o111


def test_package_is_marked_as_typed() -> None:
    assert (PACKAGE / "py.typed").is_file()


def test_every_requirement_is_pinned() -> None:
    pinned = {
        re.sub(r"[-_.]+", "-", line.split("==")[0]).lower()
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    extras = project()["project"]["optional-dependencies"]
    wanted = [*project()["project"]["dependencies"], *(r for group in extras.values() for r in group)]
    names = {re.match(r"[A-Za-z0-9._-]+", r).group().lower() for r in wanted}  # type: ignore[union-attr]
    assert names - {"avtorch"} <= pinned


def test_torch_is_pinned_as_in_ci() -> None:
    assert "torch==2.13.0" in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()


def test_modules_say_what_they_are() -> None:
    texts = {path: path.read_text(encoding="utf-8").lstrip() for path in SOURCES}
    assert not [path for path, text in texts.items() if text and not text.startswith(('"""', 'r"""'))]
    assert not [path for path, text in texts.items() if len(text.splitlines()) > 600], "a file of one idea is shorter"


def test_no_rooms_without_a_name() -> None:
    assert not [p for p in SOURCES if p.stem in ("utils", "helpers", "common", "misc")]


def test_types_of_arrays_are_defined_once() -> None:
    alias = re.compile(r"^\w+ = NDArray\[np\.(?:bool_|float64|int64)\]$", re.M)
    tests = (ROOT / "tests").rglob("*.py")
    assert [path for path in [*SOURCES, *tests] if alias.search(path.read_text(encoding="utf-8"))] == [
        PACKAGE / "arrays.py"
    ]


FILLED = {
    "gap/simulator/effect.py": "the table of effects, one for all, to which a user adds",
    "io/answers.py": "folders that this process writes",
}


def test_what_a_file_has_computed_belongs_to_an_object() -> None:
    """No empty container at the top of a module, to be filled as calls come: two searches would share it."""
    empty = re.compile(r"^(?:\{\}|\[\]|(?:\w+\.)?(?:dict|list|set|Weak\w+|defaultdict|OrderedDict|deque)\([^()]*\))$")
    found = [
        f"{path}, line {node.lineno}: {ast.unparse(node)}"
        for path in SOURCES
        if path.relative_to(PACKAGE).as_posix() not in FILLED
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None
        if empty.match(ast.unparse(node.value))
    ]
    assert not found


def imports() -> dict[str, set[str]]:
    """Which files a file imports, anywhere in it: within functions and for types only, too."""
    names = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in SOURCES}
    graph: dict[str, set[str]] = {}
    for name, path in names.items():
        graph[name] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                inner = [f"{node.module}.{alias.name}" for alias in node.names]
                found = [x if x in names else node.module for x in inner]
            else:
                continue
            graph[name] |= {x for x in found if x in names and x != name}
    return graph


def test_no_two_files_import_each_other_by_any_way_round() -> None:
    graph = imports()
    assert sum(map(len, graph.values())) > 1000  # it was read
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as circle:
        pytest.fail(f"a circle: {' -> '.join(circle.args[1])}")


@pytest.mark.parametrize("package", ["torch", "matplotlib", "rich", "cyclopts", "pyro", "arviz"])
def test_logs_are_read_without(package: str) -> None:
    imports = re.compile(rf"^\s*(import|from) {package}\b", re.M)
    found = [path for path in (PACKAGE / "io").glob("*.py") if imports.search(path.read_text(encoding="utf-8"))]
    assert not found


def test_readme_names_only_what_exists() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / target).exists(), target


def test_readme_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.S)
    for block in blocks:
        assert len(block.strip().splitlines()) <= 12
        exec(compile(block, "README.md", "exec"), {})
    assert "2.24" in capsys.readouterr().out
