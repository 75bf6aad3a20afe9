"""What `import avtorch` promises, and what it costs."""

from __future__ import annotations

import ast
import importlib.metadata
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

import avtorch

PROMISED = ["GLVD", "SGLD", "LinearController", "simulate", "Log", "estimate", "stability", "InputError"]


@pytest.mark.parametrize("name", sorted({*avtorch.__all__, *PROMISED}))
def test_every_public_name_is_there_and_explained(name: str) -> None:
    assert name in avtorch.__all__
    assert name in dir(avtorch)
    assert getattr(avtorch, name).__doc__


@pytest.mark.parametrize("module", [avtorch, avtorch.plots], ids=lambda module: module.__name__)
def test_what_type_checkers_see_is_what_is_loaded(module: Any) -> None:
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {
        (alias.name, node.module) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert seen == set(module._MODULE_OF.items())
    assert {name for name, _ in seen} == set(module.__all__)
    assert all(getattr(module, name) is not None for name in module.__all__)
    with pytest.raises(AttributeError, match="avtrch"):
        module.avtrch  # noqa: B018


def loaded(code: str, modules: Iterable[str]) -> list[str]:
    """Which of `modules` a new process has loaded after `code`."""
    code += f"; import sys; print(*[m for m in {[*modules]!r} if m in sys.modules])"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()


def test_import_is_light() -> None:
    heavy = ("numpy", "torch", "matplotlib", "pyarrow", "scipy", "pyro", "arviz")
    assert loaded("import avtorch, avtorch.cli", heavy) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tokens", "heavy"),
    [
        # half of the command's time was imports that no estimate uses
        (["estimate", "drive.csv", "--estimator", "map"], "scipy sympy pandas pyarrow pyro arviz gap validation paper"),
        # torch and Matplotlib are nine tenths of the command's processor time; nothing else may add to it
        (["stability"], "inference gap decision pandas pyarrow scipy sympy"),
    ],
    ids=["estimate", "stability"],
)
def test_a_command_imports_no_more_than_it_needs(
    tokens: list[str], heavy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    log = avtorch.simulate(avtorch.Leader.default(start=50.0, duration=6.0, dt=0.05)).log()
    log.write(tmp_path / "drive.csv")
    code = f"from avtorch.cli.app import main; assert main({[*tokens, '--out', 'out', '--quiet']!r}) == 0"
    assert loaded(code, [name for word in heavy.split() for name in (word, f"avtorch.{word}")]) == []


@pytest.mark.slow
def test_numerics_need_no_plotting() -> None:
    assert loaded("import avtorch; avtorch.GLVD, avtorch.SGLD, avtorch.simulate", ["matplotlib"]) == []


def test_installed_version_is_the_module_s() -> None:
    assert importlib.metadata.version("avtorch") == avtorch.__version__
