"""An old name works for a version and says what to write; the warning names the caller's line."""

from __future__ import annotations

import ast
import inspect

import pytest
from matplotlib.figure import Figure

from avtorch.deprecation import renamed
from avtorch.errors import InputError
from avtorch.plots import string_probability
from tests.public_names import every


@renamed(until="0.3", log="logs")
def rows(logs: list[int], *, most: int = 9) -> int:
    """Rows."""
    return min(len(logs), most)


def test_the_new_name_is_silent() -> None:
    assert rows(logs=[1, 2]) == rows([1, 2]) == 2


def test_the_old_one_works_and_says_what_to_write() -> None:
    with pytest.warns(DeprecationWarning, match=r"rows\(log=...\) is deprecated, write logs=...; avtorch 0.3") as seen:
        assert rows(log=[1, 2], most=1) == 1  # type: ignore[call-arg]
    assert seen[0].filename == __file__


def test_both_are_one_too_many() -> None:
    with pytest.raises(InputError, match="log: given beside logs"):
        rows(logs=[1], log=[1])  # type: ignore[call-arg]


def test_help_shows_the_new_name_alone() -> None:
    assert list(inspect.signature(rows).parameters) == ["logs", "most"]


def test_a_drawing_takes_the_old_name() -> None:
    with pytest.warns(DeprecationWarning, match="target=...") as seen:
        ax = string_probability(Figure().subplots(), [], target=0.9)  # type: ignore[call-arg]
    assert seen[0].filename == __file__
    assert "target 0.9" in ax.get_legend_handles_labels()[1]


def test_what_takes_a_log_calls_it_so() -> None:
    """One word for one thing: `log`, `logs` for one or several, or the two sides of a comparison."""
    taking = [
        argument.arg
        for public in every()
        if isinstance(public.node, ast.FunctionDef) and public.module != "avtorch.io.source"
        for argument in (*public.node.args.args, *public.node.args.kwonlyargs)
        if argument.annotation is not None and "LogSource" in ast.unparse(argument.annotation)
    ]
    assert len(taking) > 8
    assert set(taking) == {"log", "logs", "before", "after"}
