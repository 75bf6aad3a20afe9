"""What `import avtorch` promises, and what it costs."""

from __future__ import annotations

import ast
import importlib.metadata
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import avtorch

PROMISED = ["GLVD", "SGLD", "LinearController", "simulate", "Log", "estimate", "stability", "InputError"]


@pytest.mark.parametrize("name", sorted({*avtorch.__all__, *PROMISED}))
def test_every_public_name_is_there_and_explained(name: str) -> None:
    assert name in avtorch.__all__
    assert name in dir(avtorch)
    assert getattr(avtorch, name).__doc__


def test_what_type_checkers_see_is_what_is_loaded() -> None:
    tree = ast.parse(Path(avtorch.__file__).read_text(encoding="utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {
        (alias.name, node.module) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert seen == set(avtorch._MODULE_OF.items())
    assert {name for name, _ in seen} == set(avtorch.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="avtrch"):
        avtorch.avtrch  # noqa: B018


def test_import_is_light() -> None:
    code = (
        "import sys, avtorch, avtorch.cli;"
        "print(*[m for m in ('numpy', 'torch', 'matplotlib', 'pyarrow', 'scipy', 'pyro', 'arviz') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.slow
def test_estimate_imports_no_more_than_it_needs(tmp_path: Path) -> None:
    """Half of the command's time was imports that no estimate uses."""
    log = avtorch.simulate(avtorch.Leader.default(start=50.0, duration=6.0, dt=0.05)).log()
    log.write(tmp_path / "drive.csv")
    tokens = ["estimate", str(tmp_path / "drive.csv"), "--out", str(tmp_path / "out"), "--estimator", "map", "--quiet"]
    heavy = (
        *("scipy", "sympy", "pandas", "pyarrow", "pyro", "arviz"),
        *("avtorch.gap", "avtorch.validation", "avtorch.paper"),
    )
    code = (
        f"import sys; from avtorch.cli.app import main; assert main({tokens!r}) == 0;"
        f"print(*[m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


@pytest.mark.slow
def test_stability_imports_no_estimator(tmp_path: Path) -> None:
    """torch and Matplotlib are nine tenths of the command's processor time; nothing else may add to it."""
    heavy = ("avtorch.inference", "avtorch.gap", "avtorch.decision", "pandas", "pyarrow", "scipy", "sympy")
    tokens = ["stability", "--out", str(tmp_path / "out"), "--quiet"]
    code = (
        f"import sys; from avtorch.cli.app import main; assert main({tokens!r}) == 0;"
        f"print(*[m for m in {heavy!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_pictures_as_type_checkers_see_them_are_those_that_are_loaded() -> None:
    tree = ast.parse(Path(avtorch.plots.__file__).read_text(encoding="utf-8"))
    block = next(n for n in tree.body if isinstance(n, ast.If))
    seen = {
        (alias.name, node.module) for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names
    }
    assert seen == set(avtorch.plots._MODULE_OF.items())
    assert {name for name, _ in seen} == set(avtorch.plots.__all__)
    assert all(getattr(avtorch.plots, name) is not None for name in avtorch.plots.__all__)
    with pytest.raises(AttributeError, match="belief_figur"):
        avtorch.plots.belief_figur  # noqa: B018


@pytest.mark.slow
def test_numerics_need_no_plotting() -> None:
    code = "import sys, avtorch; avtorch.GLVD, avtorch.SGLD, avtorch.simulate; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_installed_version_is_the_module_s() -> None:
    assert importlib.metadata.version("avtorch") == avtorch.__version__


def test_the_face_as_the_documentation_shows_it() -> None:
    car = avtorch.GLVD(0.3, 1.0)
    a = torch.zeros(4, dtype=torch.float64)
    u = torch.ones(4, dtype=torch.float64)
    assert torch.allclose(car.jerk(a, u), torch.full_like(a, 1 / 0.3))
    rollout = car.rollout(torch.zeros((), dtype=torch.float64), torch.ones(50, dtype=torch.float64), 0.01).detach()
    assert rollout.shape == (50,)
    # one step of the exact solution: 1 - exp(-dt/T)
    assert float(rollout[0]) == pytest.approx(-math.expm1(-0.01 / 0.3), rel=1e-12)
    gain = avtorch.stability.peak_gain(1.5, 0.5, 1.0, (1.5, 1.5, -0.8))
    assert float(gain) == pytest.approx(2.2445, abs=5e-5)
