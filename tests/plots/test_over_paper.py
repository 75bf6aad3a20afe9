"""Drawings of the paper's experiments take an axes, return it, and show what they were given."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from avtorch.paper import Leaders, reproduce
from avtorch.plots import paper as over_paper
from avtorch.plots import paper_pictures


def test_axes_in_axes_out() -> None:
    ax = Figure().subplots()
    x, y = np.array([0.1, 1.0]), np.array([[0.1, 0.2], [0.9, 1.1]])
    assert over_paper.tracked(ax, x, y, y - 0.1, y + 0.1, name="T_L") is ax
    marks = next(line for line in ax.lines if line.get_label() == "mean")
    assert sorted(np.asarray(marks.get_ydata())) == [0.1, 0.2, 0.9, 1.1]
    other = Figure().subplots()
    assert over_paper.error_growth(other, x, {"a": y, "b": 2 * y}, along="T_L", of="K_L") is other
    assert np.allclose(other.lines[0].get_ydata(), [0.15, 1.0])
    for ax, drawn in (
        (Figure().subplots(), over_paper.gain_effects),
        (Figure().subplots(), lambda a, f, m, gain: over_paper.amplitude_by_position(a, m)),
    ):
        assert drawn(ax, (1.0, 2.0), {"a": [2.0, 1.0]}, gain="k_s") is ax
    time = np.linspace(0.0, 1.0, 3)
    ax = Figure().subplots()
    assert over_paper.platoon_speeds(ax, time, time, np.stack([time, 2 * time]), hit_s=0.5) is ax
    assert "after a collision" in ax.get_legend_handles_labels()[1]
    ax = Figure().subplots()
    assert over_paper.setting_traces(ax, time, {"leader": time, "no action": time}, quantity="speed") is ax
    assert over_paper.setting_gains(Figure().subplots(), time + 0.1, {"no action": time}).get_xscale() == "log"


@pytest.mark.slow
def test_every_experiment_has_a_picture() -> None:
    found = reproduce(["regions", "estimation", "monitoring", "gains"], leaders=Leaders.read(), seeds=2).found
    pictures = paper_pictures(found)
    assert list(pictures) == ["regions.png", "estimation.png", "monitoring.png", "gains.png"]
    for draw in pictures.values():
        figure = draw()
        figure.draw_without_rendering()
        assert all(ax.has_data() for ax in figure.axes)
