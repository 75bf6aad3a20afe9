"""Controls of the workbench: a check box and a slider that a screen reader can name, and the traces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import param
from bokeh.models import ColumnDataSource, CustomJS, Range1d
from bokeh.plotting import figure
from panel.custom import JSComponent

from avtorch.arrays import FloatArray, IntArray
from avtorch.report.page import text_of

STYLES: list[Any] = [text_of("style.css"), text_of("app.css", "avtorch.app")]
"""The report's, and the workbench's own."""
COLOURS = {"command": "#8f7fc0", "measured": "#868686", "simulator as it is": "#d0702c", "as set here": "#2f8bc4"}
"""Of the lines; each is seen on white and on black."""
_MOST = 6000  # points of a line


class CheckBox(JSComponent):
    """A box with a `label`, ticked where `value`."""

    label, value = param.String(), param.Boolean(True)
    _stylesheets = STYLES
    _esm = """export function render({ model }) {
      const label = document.createElement("label"), box = document.createElement("input");
      box.type = "checkbox"; box.checked = model.value;
      box.addEventListener("change", () => { model.value = box.checked; });
      label.append(box, " " + model.label);
      return label;
    }"""


class Slider(JSComponent):
    """A `value` from `low` to `high`, shown with its `unit` beside the `label`."""

    label, unit = param.String(), param.String()
    low, high, value = param.Number(), param.Number(), param.Number()
    _stylesheets = STYLES
    _esm = """export function render({ model }) {
      const label = document.createElement("label"), text = document.createElement("span");
      const range = document.createElement("input");
      Object.assign(range, {type: "range", min: model.low, max: model.high, step: "any", value: model.value});
      const shown = () => {
        text.textContent = `${model.label}: ${Number(range.value).toPrecision(3)} ${model.unit}`;
        range.setAttribute("aria-valuetext", text.textContent);
      };
      let timer = null;
      range.addEventListener("input", () => {
        shown();
        clearTimeout(timer);
        timer = setTimeout(() => { model.value = Number(range.value); }, 50);
      });
      shown();
      label.append(text, range);
      return label;
    }"""


class Chart:
    """Lines over `time` (row,) [s], a figure for each quantity, below one another; a stretch that is drawn with the
    mouse is enlarged in all of them, a double click shows the whole.

    `lines`: by quantity, such as `speed [m/s]`, then by name, values (row,). They break between `stretch`es (row,).
    """

    def __init__(self, time: FloatArray, lines: Mapping[str, Mapping[str, FloatArray]], stretch: IntArray) -> None:
        self._keep = np.arange(0, len(time), max(1, len(time) // _MOST))
        self._breaks = np.flatnonzero(np.diff(stretch[self._keep])) + 1
        ends = float(time[0]), float(time[-1])
        x_range = Range1d(start=ends[0], end=ends[1], bounds=ends)
        whole = CustomJS(args={"r": x_range}, code="[r.start, r.end] = r.bounds;")
        self.source, self.figures = ColumnDataSource({"time": self._thin(time)}), []
        for quantity, each in lines.items():
            drawn = figure(
                height=220,
                sizing_mode="stretch_width",
                x_range=x_range,
                x_axis_label="time [s]",
                y_axis_label=quantity,
                tools="xbox_zoom",
                toolbar_location=None,
                stylesheets=STYLES[1:],
            )
            drawn.js_on_event("doubletap", whole)
            for name, values in each.items():
                self.source.add(self._thin(values), quantity + name)
                drawn.line("time", quantity + name, source=self.source, color=COLOURS[name], line_width=1.8)
            self.figures.append(drawn)
        names = dict.fromkeys(name for each in lines.values() for name in each)
        self.legend = " ".join(
            f'<span style="color: {COLOURS[x]}" aria-hidden="true">▬</span> {x}&ensp;' for x in names
        )

    def _thin(self, values: FloatArray) -> Any:
        return np.insert(np.asarray(values, float)[self._keep], self._breaks, np.nan)

    def show(self, lines: Mapping[tuple[str, str], FloatArray]) -> None:
        """Other values (row,) for lines by quantity and name."""
        held = cast(dict[str, Any], self.source.data)
        self.source.update(data=held | {q + name: self._thin(x) for (q, name), x in lines.items()})
