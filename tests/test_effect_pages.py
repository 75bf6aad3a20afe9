"""Every effect has its page, every page an effect, and what a page says of equation and ranges is the class's own."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest

from avtorch.gap import EFFECTS, Effect

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted((DOCS / "effects").glob("*.md"))
SECTIONS = ["On a car", "Signature", "What it is mistaken for", "How to tell"]


def figures(kind: type[Effect]) -> list[str]:
    """Rows of the page's table: the parameters that an answer reports, with their typical and possible ranges."""

    def number(x: float) -> str:
        return f"{x:g}"

    shown = [p for p in (*kind.parameters, *kind.derived) if p.reported or p in kind.derived]
    rows = []
    for p in shown:
        low, high = p.possible if p.possible is not None else (-math.inf, math.inf)
        possible = "any" if math.isinf(low) and math.isinf(high) else f"{number(low)} to {number(high)}"
        rows.append(f"| `{p.name}` | {p.unit} | {number(p.low)} to {number(p.high)} | {possible} |")
    return rows


def test_every_effect_has_a_page_and_every_page_an_effect() -> None:
    assert {page.stem for page in PAGES} == set(EFFECTS)


def test_the_overview_lists_all_of_them() -> None:
    text = (DOCS / "effects.md").read_text(encoding="utf-8")
    above, _, table = text.partition("## One effect at a time")
    for part in (above, table):
        assert set(re.findall(r"\]\(effects/(\w+)\.md\)", part)) == set(EFFECTS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_true_of_its_class(page: Path) -> None:
    text, kind = page.read_text(encoding="utf-8"), EFFECTS[page.stem]
    flat = " ".join(text.split())
    assert " ".join(f"`{kind.equation}`".split()) in flat
    assert kind.meaning[1:] in flat
    assert [line for line in text.splitlines() if line.startswith("| `")] == figures(kind)
    assert re.findall(r"^## (.*)$", text, re.M) == SECTIONS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_effects_that_a_page_names_are_effects(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for shown, target in re.findall(r"\[`(\w+)`\]\((\w+)\.md\)", text):
        assert shown == target
        assert shown in EFFECTS
        assert shown != page.stem
