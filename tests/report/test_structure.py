"""What a screen reader and a keyboard need of the page: names, order, tables behind pictures."""

from __future__ import annotations

import re
from itertools import pairwise

import pytest

from tests.report.pages import PAGES
from tests.report.tree import Element, read

PICTURES = {"diagnosis": 17, "estimates": 2, "run": 3, "comparison": 1, "simulators": 1, "validation": 4}
"""Of each page, by its name."""
SLOW = {"validation"}
"""Its draws take seconds."""


@pytest.fixture(
    scope="module", params=[pytest.param(page, marks=[pytest.mark.slow] * (page in SLOW)) for page in PICTURES]
)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def text(name: str, request: pytest.FixtureRequest) -> str:
    if name != "diagnosis":
        return PAGES[name]()
    return request.getfixturevalue("page_text")


@pytest.fixture(scope="module")
def page(text: str) -> Element:
    return read(text)


def test_every_picture_has_words_and_a_table(name: str, page: Element) -> None:
    figures = list(page.all("figure"))
    assert len(figures) == PICTURES[name]
    for figure in figures:
        (svg,) = figure.all("svg")
        assert svg.attributes["role"] == "img"
        assert len(svg.attributes["aria-label"]) > 40
        for details in figure.all("details"):
            assert details.inside[0].tag == "summary"
            assert details.inside[0].text()
        assert any(
            len(list(table.all("tr"))) > 1 for details in figure.all("details") for table in details.all("table")
        )
    assert len(list(page.all("svg"))) == len(figures), "no picture outside a figure"
    assert not list(page.all("img"))


def test_tables_have_captions_headers_and_labelled_cells(name: str, page: Element) -> None:
    tables = list(page.all("table"))
    assert len(tables) >= {"diagnosis": 8}.get(name, 2)
    for table in tables:
        assert next(table.all("caption")).text()
        columns = [th for th in table.all("th") if th.attributes["scope"] == "col"]
        titles = [th.text() for th in columns]
        assert all(titles)
        for row in next(table.all("tbody")).all("tr"):
            first, *others = row.inside
            assert (first.tag, first.attributes["scope"], bool(first.text())) == ("th", "row", True)
            assert [cell.attributes["data-column"] for cell in others] == titles[1:]
        # a table shown as blocks on a phone remains one for a screen reader only by its roles
        roles = {"table": "table", "thead": "rowgroup", "tbody": "rowgroup", "tr": "row", "td": "cell"}
        for element in (table, *table.all(*roles)):
            assert element.attributes["role"] == roles[element.tag]


def test_headings_are_in_order_and_name_their_sections(page: Element) -> None:
    levels = [int(heading.tag[1]) for heading in page.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    ids = {element.attributes["id"] for element in page.all("h1", "h2")}
    assert {section.attributes["aria-labelledby"] for section in page.all("section", "footer")} == ids


def test_landmarks_and_language(page: Element) -> None:
    assert [len(list(page.all(tag))) for tag in ("main", "footer")] == [1, 1]
    assert next(page.all("html")).attributes["lang"] == "en"
    assert next(page.all("title")).text()


def test_ids_are_unique_and_every_reference_is_met(text: str, page: Element) -> None:
    ids = [element.attributes["id"] for element in page.all() if "id" in element.attributes]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="|url\()#([^")]+)', text)) <= set(ids)


def test_it_requests_nothing(name: str, page: Element) -> None:
    """No element that loads, no address in an attribute or a style but the page's own ids; clouds are within it."""
    assert not list(page.all("link", "img", "iframe", "object", "embed", "video", "audio"))
    clouds = list(page.all("image"))
    assert bool(clouds) == (name == "validation")
    assert not list(page.all("script"))
    for element in page.all():
        for attribute, value in element.attributes.items():
            if element.tag == "image" and attribute == "xlink:href":
                assert re.fullmatch(r"data:image/png;base64,[A-Za-z0-9+/=\s]+", value)
                continue
            if not attribute.startswith("xmlns"):
                assert "//" not in value, (element.tag, attribute)
            if attribute in ("src", "href", "xlink:href"):
                assert value.startswith("#")
            assert not re.search(r"url\((?!#)", value)
    (style,) = page.all("style")
    assert not re.search(r"url\(|@import", style.text())
    policy = next(x for x in page.all("meta") if x.attributes.get("http-equiv") == "Content-Security-Policy")
    images = "; img-src data:" if clouds else ""
    assert policy.attributes["content"] == f"default-src 'none'; style-src 'unsafe-inline'{images}"


def test_a_hostile_name_is_text(name: str, text: str) -> None:
    assert "<script>alert" not in text
    # a run has no file to name, a diagnosis leaves out its folder, here all before the stroke
    assert ("&lt;script&gt;alert" in text) == (name not in ("run", "diagnosis"))


def test_pictures_take_every_colour_from_the_style(page: Element) -> None:
    (style,) = page.all("style")
    known = set(re.findall(r"--([\w-]+):", style.text()))
    for svg in page.all("svg"):
        for element in svg.all():
            for name in ("style", "fill", "stroke"):
                value = element.attributes.get(name, "")
                assert not re.search(r"#[0-9a-fA-F]{3}|rgb", re.sub(r"url\(#[^)]*\)", "", value)), value
                assert set(re.findall(r"var\(--([\w-]+)\)", value)) <= known
