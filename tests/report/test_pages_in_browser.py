"""The pages of the commands beside `diagnose` in Chromium: they fit, request nothing, and are accessible."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.report.in_chromium import CUT_OFF, LETTERS_PX, OUTSIDE, PROGRAM
from tests.report.pages import PAGES

sync_api = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason="needs Chromium: Debian's chromium-headless-shell or chromium"),
]
OF_EACH = {"comparison": 10, "simulators": 10}
"""Letters of the pictures: at least so many texts."""
LEAST_PX = {("validation", 1280): 8.5}
"""Of the letters, where not 9: subscripts of three panels side by side, which a phone has one above the other."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as play:
        # the sandbox needs rights that containers lack, and the page is our own
        program = play.chromium.launch(executable_path=PROGRAM, args=["--no-sandbox"])
        yield program
        program.close()


@pytest.fixture(scope="module", params=PAGES)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    written = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    written.write_text(PAGES[request.param](), encoding="utf-8")
    return written


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 1280])
def test_it_fits_and_is_accessible(browser: Any, path: Path, width: int, scheme: Literal["light", "dark"]) -> None:
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    requests, complaints = [], []
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.goto(path.as_uri())
    page.evaluate("() => document.querySelectorAll('details').forEach(e => { e.open = true; })")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= width
    assert page.evaluate(CUT_OFF) == []
    assert page.evaluate(OUTSIDE) == []
    letters = page.evaluate(LETTERS_PX)
    assert len(letters) > OF_EACH.get(path.stem, 30)
    assert min(letters) >= LEAST_PX.get((path.stem, width), 9.0), "letters of a picture that a reader can read"
    ground = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 150) == (scheme == "dark")
    assert requests == [path.as_uri()]
    assert complaints == []
    judged = axe.Axe().run(page).response
    assert [(fault["id"], [node["html"][:200] for node in fault["nodes"]]) for fault in judged["violations"]] == []
    assert len(judged["passes"]) > 10
    page.close()


def test_every_table_opens_by_keyboard(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 800})
    page.goto(path.as_uri())
    before = page.evaluate("() => [...document.querySelectorAll('details')].map(e => e.open)")
    assert before
    for _ in range(len(before) + page.locator("figure.live").count()):
        page.keyboard.press("Tab")
        if page.evaluate("() => document.activeElement.tagName") == "SUMMARY":
            page.keyboard.press("Enter")
    assert page.evaluate("() => [...document.querySelectorAll('details')].map(e => !e.open)") == before
    page.close()
