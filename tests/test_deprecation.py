"""An old name works for a version and says what to write; the warning names the caller's line."""

from __future__ import annotations

import inspect

import pytest

from avtorch.deprecation import renamed
from avtorch.errors import InputError


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
