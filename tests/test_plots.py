"""Drawings show what they were given, and leave the reader's style alone."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib as mpl
import numpy as np
import pytest
import torch
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from avtorch import plots
from avtorch.errors import InputError
from avtorch.io import Log
from avtorch.plots.plane import setting_region, verdict_map
from avtorch.plots.style import AMPLIFIES, STABLE, UNSTABLE
from avtorch.plots.time import belief_band, data_quality, motion, string_probability


def stat(mean: float, half: float) -> dict[str, float]:
    return {"mean": mean, "sd": half / 1.645, "q05": mean - half, "q95": mean + half}


def window(start: float, *, lag: float = 0.3, excited: bool = True, p: float = 1.0) -> dict:
    ends = {"start_s": start, "end_s": start + 2.0, "n": 200, "excited": excited, "used": excited, "alerts": []}
    return {**ends, "T_L": stat(lag, 0.05), "K_L": stat(1.0, 0.1), "p_string_stable": p}


WINDOWS = [window(0.0), window(2.0, excited=False), window(4.0, lag=1.5, p=0.0), window(6.0, lag=1.5, p=0.9)]
SETTING = {"T_hat": 0.3, "K_hat": 1.0, "T_d": 0.3, "K_d": 1.0, "time_gap_s": 1.0, "gains": [1.5, 1.5, -0.8]}
ANSWER = {
    "change": {"time_s": 4.0, "T_L": 1.5, "K_L": 0.5},
    "windows": WINDOWS,
    "alerts": [{"time_s": 6.0, "detector": "stability", "why": "x"}],
    "actions": [{"time_s": 6.0, "strategies": [1, 2], "settings": SETTING}],
}
TIME = np.arange(0.0, 8.0, 0.01)
TRACES = {
    q: {"leader": np.sin(TIME), "without action": 1.2 * np.sin(TIME), "with action": np.sin(TIME - 0.3)}
    for q in ("speed", "accel")
}
TRUTH = {"T_L": [(0.0, 0.3), (4.0, 1.5)], "K_L": [(0.0, 1.0), (4.0, 0.5)]}


def axes():
    return Figure().subplots()


def log() -> Log:
    time = np.concatenate([np.arange(0, 4, 0.1), np.arange(6, 8, 0.1)])
    speed = np.where(time < 1, 0.0, 5.0 + 0.1 * np.sin(time))
    engaged = (time < 7).astype(float)
    return Log.from_arrays(time=time, accel_cmd=np.sin(time), speed=speed, engaged=engaged)


def mean_of(ax: Axes) -> tuple[np.ndarray, np.ndarray]:
    """The line of the mean."""
    mean = next(line for line in ax.lines if line.get_label() == "mean")
    return np.asarray(mean.get_xdata(), float), np.asarray(mean.get_ydata(), float)


def test_band_shows_interval_and_breaks_where_not_excited() -> None:
    ax = belief_band(axes(), WINDOWS, "T_L")
    x, y = mean_of(ax)
    assert np.isnan(y[(x > 2.0) & (x < 4.0)]).all()
    assert set(y[~np.isnan(y)]) == {0.3, 1.5}
    low, high = ax.get_ylim()
    assert low < 0.25
    assert high > 1.55


def test_band_breaks_across_a_gap() -> None:
    _, y = mean_of(belief_band(axes(), [window(0.0), window(10.0)], "T_L"))
    assert np.isnan(y).sum() == 1


def test_a_broad_first_prior_does_not_squeeze_the_rest() -> None:
    first = {**window(0.0, excited=False), "T_L": {"mean": 5.0, "sd": 9.0, "q05": 0.1, "q95": 30.0}}
    ax = belief_band(axes(), [first, *WINDOWS], "T_L")
    assert ax.get_ylim()[1] < 3.0


def verdict_at(ax: Axes, x: float, y: float) -> str:
    """The colour of the area on top at a point of the data."""
    at = ax.transData.transform((x, y))
    areas = sorted([*ax.patches, *ax.collections], key=lambda drawn: drawn.get_zorder())
    colour = ""
    for area in areas:
        paths = area.get_paths() if isinstance(area, Collection) else [area.get_path()]
        filled = np.atleast_2d(area.get_facecolor())
        if filled.size and any(p.contains_point(at, area.get_transform(), radius=0.5) for p in paths):
            colour = to_hex(filled[0])
    return colour.upper()


def test_map_distinguishes_the_three_verdicts() -> None:
    local = np.array([[False, True, True]] * 2)
    string = np.array([[False, False, True]] * 2)
    ax = verdict_map(axes(), [0.0, 1.0, 2.0], [0.0, 1.0], local, string)
    assert [verdict_at(ax, x, y) for y in (0.0, 1.0) for x in (0.2, 1.2, 1.8)] == [UNSTABLE, AMPLIFIES, STABLE] * 2
    assert len({UNSTABLE, AMPLIFIES, STABLE}) == 3


def test_the_legend_names_what_is_drawn() -> None:
    x = y = [0.0, 1.0]
    names = []
    for string in (np.ones((2, 2), bool), np.eye(2, dtype=bool)):
        legend = plots.verdict_legend(verdict_map(axes(), x, y, np.ones((2, 2), bool), string)).get_legend()
        assert legend is not None
        names.append([text.get_text() for text in legend.get_texts()])
    assert names == [["string stable"], ["string stable", "stable, amplifies (lines: peak gain)"]]


def test_labels_of_lines_are_not_cut_off() -> None:
    figure = Figure(figsize=(4, 4), dpi=100)
    ranges = {"T_range": (0.02, 2.2), "K_range": (0.25, 1.3)}
    ax = setting_region(figure.subplots(), SETTING, **ranges, clouds={}, truth=None, points=101)
    figure.canvas.draw()
    frame = ax.get_window_extent()
    labels = [text.get_window_extent() for text in ax.texts]
    assert len(labels) >= 4
    for box in labels:
        assert frame.x0 < box.x0, box
        assert box.x1 < frame.x1, box
        assert frame.y0 < box.y0, box
        assert box.y1 < frame.y1, box


def test_a_probability_is_drawn_from_when_it_is_known() -> None:
    """The window from 4 to 6 s has P 0, which nobody knows at 5 s; the action at 6 s has 0.8, and 8 s is the end."""
    actions = [{"time_s": 6.0, "p_string_stable": 0.8}]
    ax = string_probability(axes(), WINDOWS, actions=actions)
    x, p = (np.asarray(values, float) for values in ax.lines[0].get_data())
    assert list(zip(x.tolist(), p.tolist(), strict=True)) == [
        (2.0, 1.0),
        (4.0, 1.0),
        (6.0, 0.0),
        (6.0, 0.8),
        (8.0, 0.9),
    ]


def test_setting_region_is_that_of_the_effective_vehicle() -> None:
    # with the lower level's model right at (1.5, 0.5) that vehicle behaves as the target and is string stable
    right = {**SETTING, "T_hat": 1.5, "K_hat": 0.5}
    ranges = {"T_range": (1.4, 1.6), "K_range": (0.45, 0.55)}
    for setting, expected in ((SETTING, AMPLIFIES), (right, STABLE)):
        ax = setting_region(axes(), setting, **ranges, clouds={}, truth=None, points=3)
        assert verdict_at(ax, 1.5, 0.5) == expected


def test_quality_shows_what_was_masked() -> None:
    ax = data_quality(axes(), log(), WINDOWS)
    labels = [t.get_text() for t in ax.get_yticklabels()]
    spans = dict(zip(labels, (len(c.get_paths()) for c in ax.collections), strict=True))
    assert spans == {"recorded": 2, "driver in charge": 1, "standstill": 1, "excited windows": 3}


@pytest.mark.parametrize("cloud", [1, 2, pytest.param(3, marks=pytest.mark.slow)])
def test_figures_are_written_whole(tmp_path: Path, cloud: int) -> None:
    draws = (torch.rand(200) * 0.1 + 0.3, torch.rand(200) * 0.1 + 0.9)
    clouds = {f"moment {i}": draws for i in range(cloud)}
    figure = plots.region_figure([("as built", SETTING)] * cloud, clouds, truth=(1.5, 0.5))
    path = plots.save(figure, tmp_path / "a.png")
    assert path.read_bytes()[:4] == b"\x89PNG"
    assert list(tmp_path.iterdir()) == [path]


def test_the_other_figures() -> None:
    figures = [
        plots.motion_figure(ANSWER, TIME, TRACES),
        plots.belief_figure(ANSWER, truth=TRUTH),
        plots.belief_figure({"windows": WINDOWS}, log=log()),
        plots.probability_figure(ANSWER),
        plots.overview_figure(ANSWER, TIME, TRACES, truth=TRUTH, bounds={"T_L": (0.1, 0.4), "K_L": (0.7, 1.0)}),
    ]
    for figure in figures:
        figure.canvas.draw()
        for legend in figure.legends:
            box = legend.get_window_extent()
            assert box.x0 >= -1, "the legend runs out of the picture"
            assert box.x1 <= figure.bbox.x1 + 1, "the legend runs out of the picture"


def test_style_of_the_reader_is_left_alone() -> None:
    before = dict(mpl.rcParams)
    plots.probability_figure({"windows": WINDOWS})
    assert dict(mpl.rcParams) == before


def test_shown_in_a_script_a_figure_is_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "a.png"
    plots.show(Figure(), path)
    assert path.read_bytes()[:4] == b"\x89PNG"
    assert capsys.readouterr().out == f"picture: {path}\n"


@pytest.mark.parametrize("kernel", [True, False])
def test_shown_in_a_notebook_a_figure_is_below_its_cell(
    kernel: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[bytes, int, str]] = []
    shell = SimpleNamespace(kernel=None) if kernel else SimpleNamespace()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    display = SimpleNamespace(Image=lambda data, width, alt: (data, width, alt), display=shown.append)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    figure = Figure(figsize=(6, 3))
    ax = figure.subplots()
    ax.plot([0, 1], [20, 19], label="leader")
    ax.set(xlabel="time [s]", ylabel="speed [m/s]", title="a slow-down")
    plots.show(figure, tmp_path / "a.png")
    # a terminal's shell shows no pictures
    assert (tmp_path / "a.png").exists() is not kernel
    told = "Figure. a slow-down: speed [m/s] over time [s], with leader."
    assert [(data[:4], *others) for data, *others in shown] == ([(b"\x89PNG", 600, told)] if kernel else [])


def test_save_refuses_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is a directory"):
        plots.save(Figure(), tmp_path)


def test_an_excited_window_that_did_not_settle_is_drawn_as_carried_over() -> None:
    lost = {**window(2.0), "used": False}
    x, y = mean_of(belief_band(axes(), [window(0.0), lost], "T_L"))
    assert np.isnan(y[x > 2.0]).all()


@pytest.mark.parametrize(
    ("raised", "acted"),
    [
        ([["stability"]] * 3, [6.0]),  # it goes on until it is acted upon
        ([["accepted_change"], ["accepted_change"], ["stability", "accepted_change"]], []),  # a second one begins
    ],
)
def test_an_alarm_is_marked_where_it_begins_and_where_it_is_acted_upon(
    raised: list[list[str]], acted: list[float]
) -> None:
    windows = [{**window(t), "alerts": names} for t, names in zip((0.0, 2.0, 4.0), raised, strict=True)]
    alerts = [{"time_s": w["end_s"], "detector": name, "why": "x"} for w in windows for name in w["alerts"]]
    actions = [{"time_s": time, "strategies": [1], "settings": SETTING} for time in acted]
    figure = plots.probability_figure({"windows": windows, "alerts": alerts, "actions": actions})
    wide = [line for line in figure.axes[0].lines if line.get_linewidth() == 5]
    assert [line.get_xdata()[0] for line in wide] == [2.0, 6.0]


def test_a_collision_is_named_in_the_spacing() -> None:
    for spacing, told in ((np.linspace(5.0, -3.0, len(TIME)), 1), (np.full_like(TIME, 5.0), 0)):
        ax = motion(axes(), TIME, {"without action": spacing}, quantity="spacing")
        assert [t.get_text() for t in ax.texts] == ["below 0: collision"] * told
