"""What tests of pages in Chromium share: where it is, and what they ask of a page."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal

import pytest

Scheme = Literal["light", "dark"]

PROGRAMS = ("chromium-headless-shell", "chromium", "google-chrome")
PROGRAM = next((path for path in map(shutil.which, PROGRAMS) if path), None)

CUT_OFF = """() => [...document.querySelectorAll("body *")]
  .filter(e => !e.closest("svg, .drawn") && !e.closest("thead") && !e.closest("caption"))
  .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5 || e.scrollWidth > e.clientWidth + 1 && e.clientWidth)
  .map(e => e.tagName + " " + e.textContent.slice(0, 60))"""
LETTERS_PX = """() => [...document.querySelectorAll("svg text")].filter(e => e.getClientRects().length)
  .map(e => parseFloat(getComputedStyle(e).fontSize) * Math.hypot(e.getCTM().a, e.getCTM().b))"""
OUTSIDE = """() => [...document.querySelectorAll("svg text")].filter(e => e.getClientRects().length).filter(e => {
  const a = e.getBoundingClientRect(), b = e.closest("svg").getBoundingClientRect();
  return a.left < b.left - 1 || a.right > b.right + 1 || a.top < b.top - 1 || a.bottom > b.bottom + 1;
}).map(e => e.textContent)"""

marks = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason="needs Chromium: Debian's chromium-headless-shell or chromium"),
]


def fits_and_is_accessible(
    browser: Any, path: Path, width: int, scheme: Scheme, *, letters: int = 0, least_px: float = 9.0
) -> None:
    """Nothing is cut off, requested or complained of, axe-core finds no violation, and pictures can be read.

    `letters`: texts that the pictures have at least, none smaller than `least_px`.
    """
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
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
    if letters:
        sizes = page.evaluate(LETTERS_PX)
        assert len(sizes) > letters
        assert min(sizes) >= least_px, "letters of a picture that a reader can read"
    ground = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, ground[4:-1].split(","))) < 150) == (scheme == "dark")
    assert requests == [path.as_uri()]
    assert complaints == []
    judged = axe.Axe().run(page).response
    assert [(fault["id"], [node["html"][:200] for node in fault["nodes"]]) for fault in judged["violations"]] == []
    assert len(judged["passes"]) > 10
    page.close()
