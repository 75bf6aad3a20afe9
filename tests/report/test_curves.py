"""What a page's script is told of a picture: from it, lines are read as they were drawn."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from avtorch.report.compact import compact
from avtorch.report.curves import Rows
from avtorch.report.picture import inline_svg
from tests.report.tree import Element, read


def drawn(rows: Rows | None = None) -> tuple[Element, dict[str, Any]]:
    figure = Figure(figsize=(5, 3), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    x = np.linspace(0.0, 20.0, 101)
    upper.plot(x, np.sin(x), label="<b>measured</b>")
    upper.axhline(0.5, label="a rule")
    upper.plot([3.0] * 9, np.arange(9.0) / 9, label="upright")
    upper.plot(x, x, "o", ls="none", label="markers")
    upper.set(ylabel="acceleration [m/s²]", ylim=(-1.2, 1.2))
    lower.plot(x, np.exp(-x), label=r"$\tau$")
    lower.set(xlabel="time [s]", yscale="log", xlim=(0, 20))
    text = inline_svg("some", figure, "A picture.", rows)
    assert isinstance(text, Markup)
    (svg,) = read(text).inside
    return svg, json.loads(svg.attributes["data-curves"])


def points(svg: Element, name: str) -> np.ndarray:
    group = next(e for e in svg.all("g") if e.attributes.get("id") == name)
    tokens = re.findall(r"[MLl]|-?(?:\d+\.?\d*|\.\d+)", next(group.all("path")).attributes["d"])
    at, command, found, numbers = np.zeros(2), "", [], []
    for token in tokens:
        if token in "MLl":
            command = token
            continue
        numbers.append(float(token))
        if len(numbers) == 2:
            at = np.array(numbers) + (at if command == "l" else 0)
            found.append(at)
            numbers = []
    return np.array(found)


def test_lines_are_read_as_they_were_drawn() -> None:
    svg, told = drawn()
    upper, lower = told["panels"]
    assert [line["label"] for line in upper["lines"]] == ["<b>measured</b>"]
    assert [line["label"] for line in lower["lines"]] == ["τ"]
    assert (upper["along"], upper["of"], lower["log"]) == ("time [s]", "acceleration [m/s²]", [0, 1])
    for panel, curve in ((upper, np.sin), (lower, lambda x: -x * np.log10(np.e))):
        left, top, right, bottom = panel["box"]
        x, y = points(svg, panel["lines"][0]["id"]).T
        a, b = (np.log10(panel["y"]) if panel["log"][1] else panel["y"]).tolist() if panel["log"][1] else panel["y"]
        t = panel["x"][0] + (x - left) / (right - left) * (panel["x"][1] - panel["x"][0])
        value = a + (bottom - y) / (bottom - top) * (b - a)
        # a hundredth of a point of a panel over a hundred points high, and as much again along it
        near = np.rint(t / 0.2) * 0.2
        assert np.abs(t - near).max() < 1e-3
        assert np.abs(value - curve(near)).max() < 2e-4 * abs(b - a)


def test_rows_come_back_as_they_were() -> None:
    t = np.linspace(0.0, 649.95, 13_000)
    values = np.sin(t / 7)
    rows = Rows(t, (t > 400).astype(int), [{"<b>measured</b>": values}])
    _, told = drawn(rows)
    letters = told["panels"][0]["lines"][0]["rows"]
    alphabet = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"
    level = np.array(
        [64 * alphabet.index(a) + alphabet.index(b) for a, b in zip(letters[::2], letters[1::2], strict=True)]
    )
    back = -1.2 + level / 4095 * 2.4
    at = np.concatenate([begin + step * np.arange(count) for begin, step, count in told["runs"]])
    assert len(at) == len(back) <= 4500
    # half of one of 4096 levels, and what a mean of three rows takes off a peak or is late at a stretch's end
    assert np.abs(back - np.sin(at / 7)).max() < 2.4 / 4095 / 2 + 0.1 / 7
    assert np.median(np.abs(back - np.sin(at / 7))) < 2.4 / 4095 / 2


def test_small_drawings_draw_the_same() -> None:
    step = "M 1.005 2 \nL 1.009 2.004 \nL 1.013 2.008 \nL 1.017 2.012 \n"
    (_, text, *_) = compact(f'<path d="{step}"/>').split('"')
    ends = np.cumsum([float(x) for x in re.findall(r"-?(?:\d+\.?\d*|\.\d+)", text)[::2]])
    assert ends == pytest.approx([1.0, 1.01, 1.01, 1.02], abs=1e-9), "rounded before the steps are taken"
    kept = compact('<g id="panel-3"><g id="a-line-3-0"/><g id="patch_2"/><g id="a-met"/><use href="#a-met"/></g>')
    assert re.findall(r'id="([^"]*)"', kept) == ["panel-3", "a-line-3-0", "a-0"]


@pytest.mark.parametrize("path", ["M 0 0 C 1 2 3 4 5.12345 6 z", "M 0 0 \nQ 1 1 2 2"])
def test_curves_stay_curves(path: str) -> None:
    (_, text, *_) = compact(f'<path d="{path}"/>').split('"')
    assert re.findall("[A-Za-z]", text) == re.findall("[A-Za-z]", path)
    assert [float(x) for x in re.findall(r"[\d.]+", text)] == [
        pytest.approx(float(x), abs=0.005) for x in re.findall(r"[\d.]+", path)
    ]
