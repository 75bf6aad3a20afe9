"""Reading lines and making a part larger, by pointer and by keyboard: values are the log's, and nothing needs it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.report import write_report
from tests.report.in_chromium import CUT_OFF, marks

pytestmark = marks


@pytest.fixture(scope="module")
def path(found: Diagnosis, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_report(found, tmp_path_factory.mktemp("page"))


@pytest.fixture
def page(browser: Any, path: Path) -> Iterator[Any]:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto(path.as_uri())
    yield page
    page.close()


def drive(page: Any) -> Any:
    """The figure of the whole drive."""
    return page.locator("figure", has=page.locator('[aria-label^="Lines over the whole drive"]')).first


def box(page: Any, figure: Any) -> dict[str, float]:
    """On screen, of the panel that comes first: its ends in the picture are those of its axes."""
    svg = figure.locator("svg >> visible=true")
    svg.scroll_into_view_if_needed()
    code = """e => { const b = JSON.parse(e.dataset.curves).panels[0], m = e.getScreenCTM();
      const [x, y, right, bottom] = b.box.map((v, i) => i % 2 ? v * m.d + m.f : v * m.a + m.e);
      return {x, y, right, bottom, begin: b.x[0], end: b.x[1]}; }"""
    return svg.evaluate(code)


def read(text: str, label: str) -> float:
    value = re.search(rf"{label} (-?[\d.]+)", text)
    assert value is not None, text
    return float(value[1])


def test_values_under_the_pointer_are_those_of_the_log(page: Any, found: Diagnosis) -> None:
    traces = found.traces
    assert traces is not None
    figure = drive(page)
    at = box(page, figure)
    for share in (0.21, 0.5, 0.83):
        page.mouse.move(at["x"] + share * (at["right"] - at["x"]), (at["y"] + at["bottom"]) / 2)
        text = figure.locator(".readout").text_content()
        time = float(text.split(" ")[0])
        # a screen's pixel is that long
        assert time == pytest.approx(at["begin"] + share * (at["end"] - at["begin"]), abs=0.2)
        # within the two rows about it: the time is told to a tenth of a second
        near = np.abs(traces.time - time) < 0.2
        k = traces.channels.index("accel")
        for label, values in (("command", traces.command), ("measured", traces.measured[k])):
            told = read(text, label)
            assert values[near].min() - 0.01 <= told <= values[near].max() + 0.01, label


def test_a_part_is_made_larger_and_whole_again(page: Any) -> None:
    figure = drive(page)
    at = box(page, figure)
    width, y = at["right"] - at["x"], (at["y"] + at["bottom"]) / 2
    line = figure.locator("svg >> visible=true").locator('[id*="-line-"] path').first
    whole = line.get_attribute("d")
    page.mouse.move(at["x"] + 0.4 * width, y)
    page.mouse.down()
    page.mouse.move(at["x"] + 0.6 * width, y, steps=3)
    page.mouse.up()
    assert "zoomed" in figure.get_attribute("class")
    assert line.get_attribute("d") != whole
    page.mouse.move(at["x"] + 0.5 * width, y)
    seconds = at["end"] - at["begin"]
    middle = float(figure.locator(".readout").text_content().split(" ")[0])
    assert middle == pytest.approx(at["begin"] + 0.5 * seconds, abs=0.01 * seconds)
    page.mouse.move(at["x"] + 2, y)
    first = float(figure.locator(".readout").text_content().split(" ")[0])
    assert first == pytest.approx(at["begin"] + 0.4 * seconds, abs=0.01 * seconds)
    page.keyboard.press("Escape")
    assert "zoomed" not in figure.get_attribute("class")
    assert line.get_attribute("d") == whole


def test_the_keyboard_reads_and_zooms(page: Any) -> None:
    figure = drive(page)
    slider = figure.locator("input[type=range]")
    slider.focus()
    page.keyboard.press("ArrowRight")
    one = slider.get_attribute("aria-valuetext")
    assert "measured" in one
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    two = slider.get_attribute("aria-valuetext")
    assert float(two.split(" ")[0]) > float(one.split(" ")[0])
    page.keyboard.press("+")
    assert "zoomed" in figure.get_attribute("class")
    assert float(slider.get_attribute("aria-valuetext").split(" ")[0]) == pytest.approx(float(two.split(" ")[0]), abs=1)
    page.keyboard.press("Shift+ArrowRight")
    page.keyboard.press("-")
    page.keyboard.press("Escape")
    assert "zoomed" not in figure.get_attribute("class")


def test_the_wheel_scrolls_the_page_until_a_picture_is_chosen(page: Any) -> None:
    figure = drive(page)
    at = box(page, figure)
    page.mouse.move((at["x"] + at["right"]) / 2, (at["y"] + at["bottom"]) / 2)
    page.mouse.wheel(0, -40)
    assert "zoomed" not in figure.get_attribute("class")
    at = box(page, figure)
    page.mouse.click((at["x"] + at["right"]) / 2, (at["y"] + at["bottom"]) / 2)
    page.mouse.wheel(0, -40)
    page.wait_for_function("() => document.querySelector('figure.zoomed')", timeout=5000)
    page.mouse.dblclick((at["x"] + at["right"]) / 2, (at["y"] + at["bottom"]) / 2)
    assert "zoomed" not in figure.get_attribute("class")


def test_a_phone_keeps_what_is_chosen_within_its_width(browser: Any, path: Path) -> None:
    page = browser.new_page(viewport={"width": 390, "height": 800}, has_touch=True)
    page.goto(path.as_uri())
    figure = drive(page)
    at = box(page, figure)
    page.touchscreen.tap((at["x"] + at["right"]) / 2, (at["y"] + at["bottom"]) / 2)
    assert "measured" in figure.locator(".readout").text_content()
    figure.locator("button", has_text="zoom in").click()
    assert "zoomed" in figure.get_attribute("class")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    assert page.evaluate(CUT_OFF) == []
    page.close()


def test_without_scripts_every_number_is_there(browser: Any, path: Path) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto(path.as_uri())
    assert page.locator(".tools, .readout").count() == 0
    assert page.locator("figure").count() == page.locator("figure:has(details table)").count() > 4
    context.close()
