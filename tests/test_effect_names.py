"""All knowledge of an effect is in its own file: no other file of the package names one, by string or by import."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from avtorch.gap import EFFECTS

PACKAGE = Path(__file__).resolve().parents[1] / "avtorch"
HOME = PACKAGE / "gap" / "effects"

ALLOWED = {
    "app/workplace.py": "the car of the simulated example has two of them",
    "external/surrogate.py": "a second pole or a limit of the rate begins from a shorter lag",
    "gap/engine": "one compiled loop for all effects: held to their own files row by row in test_compiled_plant.py",
    "gap/result": "what chance decides, and the delay beside T_L, have places of their own in an answer",
    "gap/diagnose.py": "lost messages are of the link, not of the car",
    "experiment/prediction.py": "what is unknown along a road is integrated out",
    "gap/linearised.py": "a road is no part of a loop",
    "gap/__init__.py": "offers the classes to the user by name",
    "cli/estimate.py": "the dead time is an argument of the estimators, no effect",
    "cli/stability.py": "the dead time is an argument of the stability functions, no effect",
    "vehicle/stability/belief.py": "likewise",
    "vehicle/stability/linear_loop.py": "likewise",
}


def names_in(path: Path) -> list[str]:
    """Line and text of each string that is an effect's name or a key of its, and of each import of one's class."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    bodies = [node.body for node in ast.walk(tree) if isinstance(getattr(node, "body", None), list)]  # type: ignore[attr-defined]
    docstrings = {id(line.value) for body in bodies for line in body if isinstance(line, ast.Expr)}
    keys = tuple(f"{name}." for name in EFFECTS)
    classes = {kind.__name__ for kind in EFFECTS.values()}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            if node.value in EFFECTS or node.value.startswith(keys):
                found.append(f"line {node.lineno}: {node.value!r}")
        elif isinstance(node, ast.ImportFrom):
            home = (node.module or "").startswith("avtorch.gap.effects")
            found += [f"line {node.lineno}: import of {a.name}" for a in node.names if home or a.name in classes]
        elif isinstance(node, ast.Import):
            modules = [a.name for a in node.names if a.name.startswith("avtorch.gap.effects")]
            found += [f"line {node.lineno}: import of {name}" for name in modules]
    return found


def files(allowed: bool) -> list[Path]:
    places = [PACKAGE / place for place in ALLOWED]
    every = [p for p in sorted(PACKAGE.rglob("*.py")) if HOME not in p.parents]
    return [p for p in every if any(p == place or place in p.parents for place in places) == allowed]


def test_no_other_file_names_an_effect() -> None:
    others = files(allowed=False)
    assert len(others) > 100
    assert not {str(path): found for path in others if (found := names_in(path))}


@pytest.mark.parametrize("place", ALLOWED)
def test_an_exception_is_still_needed(place: str) -> None:
    at = PACKAGE / place
    assert any(names_in(path) for path in ([at] if at.is_file() else at.glob("*.py")))
