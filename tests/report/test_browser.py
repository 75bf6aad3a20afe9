"""The page in Chromium: nothing cut off, nothing requested, no violation that axe-core finds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from avtorch.experiment import Experiment
from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report import write_report
from tests.report.in_chromium import Scheme, fits_and_is_accessible, marks

pytestmark = marks


@pytest.fixture(scope="module")
def path(found: Diagnosis, ahead: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(found, tmp_path_factory.mktemp("page"), experiment=ahead, quality=["2 rows masked"])


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 780, 1280])
def test_it_fits_and_is_accessible(browser: Any, path: Path, width: int, scheme: Scheme) -> None:
    fits_and_is_accessible(browser, path, width, scheme, letters=30)


def test_every_table_is_reached_by_keyboard(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.as_uri())
    before = page.evaluate("() => [...document.querySelectorAll('details')].map(e => e.open)")
    for _ in range(len(before) + page.locator(".drawn").count()):  # a wide picture is moved by keyboard, too
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.tagName") == "SUMMARY":
            page.keyboard.press("Enter")
    assert page.evaluate("() => [...document.querySelectorAll('details')].map(e => !e.open)") == before
    page.close()


def test_paper_is_light_and_shows_all_pictures_whole(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 700, "height": 990}, color_scheme="dark")
    page.goto(path.as_uri())
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert page.evaluate("() => getComputedStyle(document.querySelector('h1')).color") == "rgb(34, 34, 34)"
    assert page.locator("svg >> visible=true").count() == page.locator("figure").count() >= 12
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 700
    page.close()
