"""Every figure that avtorch draws is in the gallery, and the gallery's code draws a picture under each heading."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

from avtorch.plots.paper import _DRAWN

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
# Figures that are reached by a dict of them, from `paper_pictures` and `validation_figures`: there by file.
BY_FILE = ("paper.py", "posteriors.py")


def code() -> ast.Module:
    return ast.parse("\n".join(re.findall(r"^```python\n(.*?)^```$", TEXT, re.S | re.M)))


def test_every_figure_is_there() -> None:
    figures = {
        node.name
        for path in (ROOT / "avtorch" / "plots").glob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef) and re.fullmatch(r"[a-z]\w*_figures?|\w+_pictures", node.name)
        if path.name not in BY_FILE or not node.name.endswith("_figure")
    }
    assert len(figures) > 20
    calls = [node.func for node in ast.walk(code()) if isinstance(node, ast.Call)]
    assert figures <= {ast.unparse(f).rpartition(".")[2] for f in calls}


def test_every_file_of_the_paper_is_there() -> None:
    keys = {node.slice.value for node in ast.walk(code()) if isinstance(node, ast.Subscript) and _is_text(node.slice)}
    # or named as one that a command draws
    assert set(_DRAWN) <= keys | set(re.findall(r"`(\w+\.png)`", TEXT))


@pytest.mark.slow
def test_each_heading_has_its_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    titles = re.findall(r"^### (.*)$", TEXT, re.M)
    made = list(site().drawn(TEXT, tmp_path))
    assert [picture.title for picture in made] == titles
    assert len({picture.file for picture in made}) == len(titles)
    assert all((tmp_path / picture.file).stat().st_size > 5000 for picture in made)  # an empty one has some 2 kB


def site() -> ModuleType:
    """How the site draws them."""
    spec = importlib.util.spec_from_file_location("site_pictures", ROOT / "docs" / "_site" / "pictures.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)
