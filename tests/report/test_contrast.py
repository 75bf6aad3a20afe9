"""Contrast by the Web Content Accessibility Guidelines 2.2: 4.5 for text (1.4.3), 3 for what pictures need (1.4.11)."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

TEXT = ("ink", "soft", "blue", "green", "amber")
LINES = ("p-blue", "p-vermillion", "p-orange", "p-sky", "p-grey", "p-bar", "p-green", "p-purple", "p-contour")
AREAS = ("p-stable", "p-amplifies", "p-unstable")
"""Of a map; the lines between them tell them apart."""
DECORATION = {"line", "p-fill", "p-grid"}
"""Rules of tables, the grid, and a ground whose outline is p-grey."""


def palettes() -> dict[str, dict[str, str]]:
    """The style's colours by their names: those by default, and those that a dark system changes."""
    style = files("avtorch.report").joinpath("style.css").read_text(encoding="utf-8")
    by_default, dark = (
        dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block)) for block in style.split("@media", 2)[:2]
    )
    return {"light": by_default, "dark": dark}


def luminance(colour: str) -> float:
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_measure_itself() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005), (
        "just short of enough, as the standard says"
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_contrast_is_enough(scheme: str) -> None:
    colours = palettes()[scheme]
    assert {"back", "paper", *TEXT, *LINES, *AREAS, *DECORATION} == set(colours)
    for ground in ("paper", "back"):
        for name in TEXT:
            assert contrast(colours[name], colours[ground]) >= 4.5, (name, ground)
    for name in LINES:
        assert contrast(colours[name], colours["paper"]) >= 3.0, name
    for area in AREAS:
        assert contrast(colours["ink"], colours[area]) >= 4.5, area
    assert contrast(colours["p-contour"], colours["p-amplifies"]) >= 4.5, "labels of the peak gain"


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_lines_of_one_picture_differ_in_grey(scheme: str) -> None:
    """Measured, before and after: told apart without colour by lightness, besides their order in the legend."""
    colours = palettes()[scheme]
    assert contrast(colours["ink"], colours["p-vermillion"]) >= 1.8
    assert contrast(colours["ink"], colours["p-blue"]) >= 1.8
    assert contrast(colours["p-blue"], colours["p-sky"]) >= 1.3


def test_dark_is_by_the_reader_s_setting_and_never_on_paper() -> None:
    style = files("avtorch.report").joinpath("style.css").read_text(encoding="utf-8")
    assert re.findall(r"@media ([^{]*prefers-color-scheme[^{]*) {", style) == [
        "screen and (prefers-color-scheme: dark)"
    ]
