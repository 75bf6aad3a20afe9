"""The page of a fleet in Chromium: it fits, requests nothing, its table is searched and sorted, and works without."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from avtorch.report import write_fleet_page
from tests.report.conftest import HOSTILE
from tests.report.fleets import answer_of
from tests.report.in_chromium import Scheme, fits_and_is_accessible, marks

pytestmark = marks


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_fleet_page(answer_of(250), tmp_path_factory.mktemp("fleet"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 780, 1280])
def test_it_fits_and_is_accessible(browser: Any, path: Path, width: int, scheme: Scheme) -> None:
    fits_and_is_accessible(browser, path, width, scheme)


def test_cars_are_found_sorted_and_turned_over(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.as_uri())
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


def test_without_scripts_the_first_cars_are_there(browser: Any, path: Path) -> None:
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(path.as_uri())
    assert page.locator("#ranking tbody tr").count() == 200
    assert page.locator(".controls >> visible=true").count() == 0
    assert page.locator("#rest").is_visible()
    page.close()
