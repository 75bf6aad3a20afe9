"""The first picture of the page is the gap's budget, whatever the verdict."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avtorch.gap.quantity import Quantity
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report.diagnosis import _budget
from avtorch.report.page import Picture
from tests.report.tree import read

WHOLE = Quantity(1.0, 0.0, 1.0, 1.0)


def named(found: Diagnosis) -> Diagnosis:
    assert found.budget is not None
    assert found.budget.parts
    return found


def unnamed(found: Diagnosis, name: str, before: float, still: Quantity | None = None) -> Diagnosis:
    """An answer without any part, whose error is `before` times the floor; a black box may take off `still`."""
    budget = named(found).budget
    assert budget is not None
    rest = replace(budget.unexplained, share=WHOLE, material=name == "unknown", still=still)
    verdict = replace(
        found.verdict, names=(name,), alias_set=(name,), abstained=name == "unknown", why="Nothing known."
    )
    bare = replace(budget, before=before, left=before, parts=(), chance=(), unexplained=rest)
    return replace(found, budget=bare, verdict=verdict)


def picture(found: Diagnosis) -> Picture:
    """The first of the page, without the others."""
    first = _budget(found)
    assert first is not None
    return first


def test_it_is_of_the_parts(page_text: str) -> None:
    figure = next(read(page_text).all("figure"))
    rows = [[cell.text() for cell in row.all("td", "th")] for row in figure.all("tr")]
    label = next(figure.all("svg")).attributes["aria-label"]
    assert label.startswith("Bars of what each effect contributes to the gap: sensor_bias")
    assert [row[0] for row in rows[1:]] == ["sensor_bias", "unexplained"]


@pytest.mark.parametrize(
    ("name", "before", "unexplained"),
    [
        ("unknown", 2.0, "75 %"),
        ("none", 1.01, "2 %"),
        ("none", 1.0, "0 %"),
    ],
)
def test_where_nothing_is_named_it_is_of_what_is_unexplained_and_noise(
    found: Diagnosis, name: str, before: float, unexplained: str
) -> None:
    first = picture(unnamed(found, name, before))
    noise = f"{100 - int(unexplained[:-2])} %"
    assert f"unexplained {unexplained}, noise {noise}" in first.says
    assert [row[:2] for row in first.tables[0].rows] == [("unexplained", unexplained), ("noise", noise)]


def test_its_caption_says_whether_what_is_left_counts(found: Diagnosis) -> None:
    captions = {}
    for name, before in (("unknown", 2.0), ("none", 1.01), ("nothing", 1.0)):
        answer = unnamed(found, "none" if name == "nothing" else name, before)
        captions[name] = picture(answer).caption
    assert "does not count" not in captions["unknown"]
    assert "does not count" in captions["none"]
    assert "The error is noise." in captions["nothing"]


def test_a_log_that_cannot_tell_noise_says_so(found: Diagnosis) -> None:
    first = picture(unnamed(found, "none", 1.0, Quantity(0.0, 0.1, 0.0, 1.0)))
    assert "this log cannot tell" in first.caption
    assert [row[1] for row in first.tables[0].rows] == ["0 % (0 to 100)", "100 % (0 to 100)"]
