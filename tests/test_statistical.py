"""Which tests are `statistical`, read off their source: whole, whatever part of the suite a run collects."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests import bars, failed_seeds

ROOT = Path(__file__).resolve().parents[1]
MARK = "pytest.mark.statistical"
Function = ast.FunctionDef | ast.AsyncFunctionDef


def arguments(function: Function) -> set[str]:
    return {a.arg for a in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)}


def seeded(functions: list[Function]) -> set[str]:
    """`rotating_seed`, and the fixtures of this file that ask for it, themselves or through each other."""
    fixtures = [f for f in functions if any("fixture" in ast.unparse(d) for d in f.decorator_list)]
    found = {"rotating_seed"}
    while more := {f.name for f in fixtures if arguments(f) & found} - found:
        found |= more
    return found


def read(source: str) -> dict[str, tuple[bool, bool]]:
    """Of each test of a file: whether it draws from `rotating_seed`, and whether it is marked."""
    body = ast.parse(source).body
    functions = [n for n in body if isinstance(n, Function)]
    whole = any(
        isinstance(n, ast.Assign) and ast.unparse(n.targets[0]) == "pytestmark" and MARK in ast.unparse(n.value)
        for n in body
    )
    drawing = seeded(functions)
    return {
        f.name: (bool(arguments(f) & drawing), whole or any(MARK in ast.unparse(d) for d in f.decorator_list))
        for f in functions
        if f.name.startswith("test_")
    }


@pytest.fixture(scope="module")
def tests() -> dict[str, tuple[bool, bool]]:
    return {
        f"{path.relative_to(ROOT).as_posix()}::{name}": of
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        for name, of in read(path.read_text(encoding="utf-8")).items()
    }


def test_what_draws_from_the_rotating_seed_is_marked_and_nothing_else(tests: dict[str, tuple[bool, bool]]) -> None:
    assert [name for name, (draws, marked) in tests.items() if draws != marked] == []


def test_no_shared_fixture_draws_from_the_rotating_seed() -> None:
    """One of a `conftest.py` would escape the test above."""
    for path in (ROOT / "tests").rglob("conftest.py"):
        assert "rotating_seed" not in path.read_text(encoding="utf-8"), path


def test_bars_are_of_as_many_tests_as_there_are(tests: dict[str, tuple[bool, bool]]) -> None:
    assert bars.TESTS / 2 < sum(marked for _, marked in tests.values()) < 2 * bars.TESTS


def test_the_reader_finds_marks_and_fixtures() -> None:
    source = """
@pytest.fixture
def pair(rotating_seed): ...
@pytest.fixture
def four(pair): ...
def test_a(four): ...
@pytest.mark.statistical
def test_b(seed): ...
"""
    assert read(source) == {"test_a": (True, False), "test_b": (False, True)}
    assert read("pytestmark = [pytest.mark.slow, pytest.mark.statistical]\ndef test_c(): ...") == {
        "test_c": (False, True)
    }


def test_recorded_seeds_are_of_tests_that_exist(tests: dict[str, tuple[bool, bool]]) -> None:
    """A test that was renamed takes its seeds with it."""
    held = failed_seeds.read(ROOT / failed_seeds.NAME)
    assert {test.split("[")[0] for test in held} <= set(tests)
    assert held == failed_seeds.merged(held), "sorted, each once"


def test_bars_are_what_they_say() -> None:
    """Near the five sigma they replaced, and farther off where the error is known from few numbers."""
    assert 4.75 < bars.BAR < 5.0
    assert bars.sigmas(0.0455) == pytest.approx(2.0, abs=1e-3)
    assert bars.student(1e9) == pytest.approx(bars.BAR, rel=1e-6)
    assert bars.student(1, level=0.5) == pytest.approx(1.0)  # Cauchy's quartile
    assert bars.log_odds(20) == pytest.approx(bars.log_odds() + 2.9957, abs=1e-4)
