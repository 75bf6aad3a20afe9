"""Every public name, its module, and its documentation: read from the source, without an import."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (
    "avtorch",
    "avtorch.vehicle",
    "avtorch.vehicle.stability",
    "avtorch.inference",
    "avtorch.inference.estimators",
    "avtorch.decision",
    "avtorch.validation",
    "avtorch.display",
    "avtorch.io",
    "avtorch.pedals",
    "avtorch.gap",
    "avtorch.external",
    "avtorch.follower",
    "avtorch.remedy",
    "avtorch.experiment",
    "avtorch.plots",
    "avtorch.paper",
    "avtorch.report",
    "avtorch.fleet",
    "avtorch.live",
)

Documented = ast.Module | ast.ClassDef | ast.FunctionDef


class Public(NamedTuple):
    """A public name: the module that makes it, its own name there ("" for a module), and its documentation."""

    module: str
    name: str
    doc: str
    node: ast.stmt | ast.Module

    def __str__(self) -> str:
        return f"{self.module}.{self.name}".rstrip(".")


@cache
def source(module: str) -> ast.Module:
    return ast.parse(path_of(module).read_text(encoding="utf-8"))


def path_of(module: str) -> Path:
    path = ROOT / Path(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def offered(package: str) -> list[str]:
    """Its `__all__`."""
    for node in source(package).body:
        if isinstance(node, ast.Assign) and [ast.unparse(t) for t in node.targets] == ["__all__"]:
            return list(ast.literal_eval(node.value))
    raise AssertionError(f"{package} has no __all__")


@cache
def home(module: str, name: str) -> tuple[str, str]:
    """The module that makes what `module` calls `name`, and the name there, behind all re-exports."""
    if any(name in _names(node) for node in source(module).body):
        return module, name
    if name in imports(module):
        return home(*imports(module)[name])
    # a package's own module, which is nobody's import
    if path_of(f"{module}.{name}").is_file():
        return f"{module}.{name}", ""
    raise AssertionError(f"{module} neither makes nor imports {name}")


@cache
def imports(module: str) -> dict[str, tuple[str, str]]:
    """What `module` imports from others, also for type checkers alone: `{name: (module, name there)}`."""
    nodes = [n for n in ast.walk(source(module)) if isinstance(n, ast.ImportFrom) and n.module != module]
    return {a.asname or a.name: (n.module, a.name) for n in nodes if n.module for a in n.names}


def find(module: str, name: str) -> Public:
    made, own = home(module, name)
    body = source(made).body
    if not own:
        return Public(made, "", ast.get_docstring(source(made)) or "", source(made))
    for node, below in zip(body, [*body[1:], None], strict=True):
        if own in _names(node):
            if isinstance(node, ast.ClassDef | ast.FunctionDef):
                return Public(made, own, ast.get_docstring(node) or "", node)
            return Public(made, own, _text(below), node)
    raise AssertionError(f"{made} does not make {own}")


def every() -> list[Public]:
    """All public names, each once however many packages offer it."""
    found = {str(it): it for package in PACKAGES for name in offered(package) for it in [find(package, name)]}
    return [found[key] for key in sorted(found)]


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return [node.name]
    if isinstance(node, ast.Assign):
        return [t.id for t in node.targets if isinstance(t, ast.Name)]
    return [node.target.id] if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) else []


def _text(node: ast.stmt | None) -> str:
    """The documentation string below a constant."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
        return node.value.value
    return ""
