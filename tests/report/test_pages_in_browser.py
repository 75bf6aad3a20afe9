"""The pages of the commands beside `diagnose` in Chromium: they fit, request nothing, and are accessible."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.report.in_chromium import Scheme, fits_and_is_accessible, marks
from tests.report.pages import PAGES

pytestmark = marks
OF_EACH = {"comparison": 10, "simulators": 10}
"""Letters of the pictures: at least so many texts."""


@pytest.fixture(scope="module", params=PAGES)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    written = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    written.write_text(PAGES[request.param](), encoding="utf-8")
    return written


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_it_fits_and_is_accessible(browser: Any, path: Path, width: int, scheme: Scheme) -> None:
    fits_and_is_accessible(browser, path, width, scheme, letters=OF_EACH.get(path.stem, 30))


def test_every_table_opens_by_keyboard(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.as_uri())
    before = page.evaluate("() => [...document.querySelectorAll('details')].map(e => e.open)")
    assert before
    for _ in range(len(before) + page.locator(".drawn").count()):
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.tagName") == "SUMMARY":
            page.keyboard.press("Enter")
    assert page.evaluate("() => [...document.querySelectorAll('details')].map(e => !e.open)") == before
    page.close()
