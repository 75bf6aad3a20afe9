"""The pages in Chromium: nothing cut off, nothing requested, no violation that axe-core finds; a fleet's ranking."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from avtorch.report.fleet import fleet_html
from tests.report.conftest import HOSTILE
from tests.report.fleets import answer_of
from tests.report.in_chromium import Scheme, fits_and_is_accessible, marks
from tests.report.pages import PAGES

pytestmark = marks
LETTERS = {"comparison": 10, "simulators": 10, "fleet": 0}
"""Texts that a page's pictures have at least, other than 30; a fleet's cars are dots."""


@pytest.fixture(scope="module", params=["diagnosis", "fleet", *PAGES])
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if request.param == "diagnosis":
        text = request.getfixturevalue("page_text")
    else:
        text = fleet_html(answer_of(250)) if request.param == "fleet" else PAGES[request.param]()
    written = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    written.write_text(text, encoding="utf-8")
    return written


def opened(browser: Any, path: Path) -> Any:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.as_uri())
    return page


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 780, 1280])
def test_it_fits_and_is_accessible(browser: Any, path: Path, width: int, scheme: Scheme) -> None:
    fits_and_is_accessible(browser, path, width, scheme, letters=LETTERS.get(path.stem, 30))


@pytest.mark.parametrize("path", ["diagnosis", *PAGES], indirect=True)
def test_every_table_is_reached_by_keyboard(browser: Any, path: Path) -> None:
    page = opened(browser, path)
    before = page.evaluate("() => [...document.querySelectorAll('details')].map(e => e.open)")
    assert before
    for _ in range(len(before) + page.locator(".drawn").count()):  # a wide picture is moved by keyboard, too
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.tagName") == "SUMMARY":
            page.keyboard.press("Enter")
    assert page.evaluate("() => [...document.querySelectorAll('details')].map(e => !e.open)") == before
    page.close()


@pytest.mark.parametrize("path", ["diagnosis"], indirect=True)
def test_paper_is_light_and_shows_all_pictures_whole(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 700, "height": 990}, color_scheme="dark")
    page.goto(path.as_uri())
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate("() => getComputedStyle(document.querySelector('h1')).color") == "rgb(34, 34, 34)"
    assert page.locator("svg >> visible=true").count() == page.locator("figure").count() >= 12
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 700
    page.close()


@pytest.mark.parametrize("path", ["fleet"], indirect=True)
def test_cars_are_found_sorted_and_turned_over(browser: Any, path: Path) -> None:
    page = opened(browser, path)
    first = page.locator("#ranking tbody tr").first.locator("th")
    seen = page.locator("#seen")
    assert seen.text_content() == "Cars 1 to 100 of 250"
    first_cells = page.locator("#ranking tbody tr").first.locator("th, td")
    titles = page.locator("#ranking thead th").all_text_contents()
    shown = dict(zip(titles, first_cells.all_text_contents(), strict=True))
    assert (shown["car"], shown["rank"], shown["logs"]) == ("car 1", "1", "1")
    page.click("#on")
    page.click("#on")
    assert (seen.text_content(), first.text_content()) == ("Cars 201 to 250 of 250", "car 201")
    assert page.locator("#on").is_disabled()
    page.fill("#find", "script")
    assert (seen.text_content(), first.text_content()) == ("Cars 1 to 1 of 1", HOSTILE)
    page.fill("#find", "no such car")
    assert seen.text_content() == "No car has these words"
    page.fill("#find", "")
    page.select_option("#by", label="P(string stable)")
    page.click("#turn")
    assert first.text_content() == "car 250"
    page.select_option("#by", label="siblings")
    page.click("#turn")
    assert first.text_content() == "car 1", "the smallest tail first"
    page.select_option("#why", label="sound")
    assert seen.text_content() == "Cars 1 to 25 of 25"
    page.close()


@pytest.mark.parametrize("path", ["fleet"], indirect=True)
def test_without_scripts_the_first_cars_are_there(browser: Any, path: Path) -> None:
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(path.as_uri())
    assert page.locator("#ranking tbody tr").count() == 200
    assert page.locator(".controls >> visible=true").count() == 0
    assert page.locator("#rest").is_visible()
    page.close()
