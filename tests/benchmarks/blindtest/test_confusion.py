"""The confusion matrix shows every case once, in the right cell."""

from __future__ import annotations

import pytest
from matplotlib.figure import Figure

from avtorch.errors import InputError
from benchmarks.blindtest.confusion import confusion, confusion_figure

COUNTS = {
    "none": {"none": 9, "gust": 1},
    "unknown": {"unknown": 3, "aerodynamic_drag": 2},
    "sensor_lag": {"sensor_lag": 4, "dead_time+sensor_lag": 1},
    "dead_time+gust": {"dead_time+gust": 5, "dead_time+sensor_lag": 2, "failed": 1},
    "aerodynamic_drag+gust": {"aerodynamic_drag": 2},
    "dead_time+gust+sensor_lag": {"dead_time+gust+sensor_lag": 1, "dead_time+gust": 1},
}


def cells(ax) -> dict[tuple[str, str], int]:
    rows = [t.get_text().rsplit("  (", 1)[0] for t in ax.get_yticklabels()]
    columns = [t.get_text() for t in ax.get_xticklabels()]
    return {
        (rows[round(t.get_position()[1])], columns[round(t.get_position()[0])]): int(t.get_text()) for t in ax.texts
    }


def test_every_case_is_drawn_once_and_sets_are_put_together() -> None:
    ax = Figure().subplots()
    assert confusion(ax, COUNTS) is ax
    assert cells(ax) == {
        ("none", "none"): 9,
        ("none", "gust"): 1,
        ("outside the table", "outside the table"): 3,
        ("outside the table", "aerodynamic drag"): 2,
        ("sensor lag", "sensor lag"): 4,
        ("sensor lag", "other causes"): 1,
        ("several causes", "several causes"): 6,
        ("several causes", "other causes"): 3,
        ("several causes", "no answer"): 1,
        ("several causes", "aerodynamic drag"): 2,
    }
    assert [t.get_text() for t in ax.get_yticklabels()] == [
        "none  (10)", "sensor lag  (5)", "several causes  (12)", "outside the table  (5)"
    ]  # fmt: skip


def test_figure_and_nothing_to_draw() -> None:
    figure = confusion_figure({"confusion": COUNTS, "cases": 32, "answerer": "avtorch", "signals": ["accel"]})
    assert "22 of 32" in figure.axes[0].get_title(loc="left")
    # the narrowest there is: nothing is cut off at the edge
    few = {"confusion": {"none": {"none": 1}}, "cases": 1, "answerer": "avtorch", "signals": ["accel", "speed"]}
    small = confusion_figure(few)
    small.draw_without_rendering()
    title = small.axes[0]._left_title  # type: ignore[attr-defined]
    assert title.get_window_extent().x1 <= small.bbox.x1
    with pytest.raises(InputError, match="counts: found no case"):
        confusion(Figure().subplots(), {})
