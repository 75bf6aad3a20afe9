"""The whole drive: no peak is lost, nothing is drawn across a gap, logs lie one behind the other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avtorch.errors import InputError
from avtorch.gap.result.traces import Alarm, Traces, Uncounted
from avtorch.plots.drive import drive_figure, drive_time, envelope

STEP = 0.05


def found(channels: tuple[str, ...] = ("accel", "speed"), **more: Any) -> Any:
    """Two logs of 60 s; in the first the driver had the car from 20 to 30 s."""
    one = STEP * np.concatenate([np.arange(400), np.arange(600, 1200)])
    time, stretch = np.concatenate([one, one[:400]]), np.repeat([0, 1, 2], [400, 600, 400])
    rng = np.random.default_rng(0)
    lines = [rng.normal(size=(len(channels), len(time))) for _ in range(3)]
    unused = (
        Uncounted(0.0, 0.0, "settling"),
        Uncounted(20.0, 28.0, "driver"),
        Uncounted(28.0, 30.0, "settling"),
        Uncounted(4.0, 6.0, "standstill", 1),
    )
    traces = Traces(time, np.sin(time), channels, *lines, np.zeros(len(time)), stretch, unused)
    given: dict[str, Any] = {"traces": traces, "onset_from_start_s": None, "onset_log": 0, "alarms": ()}
    given |= {"winner": SimpleNamespace(effects=("x",)), "free_form": None}
    return SimpleNamespace(**{**given, **more})


def test_an_envelope_keeps_every_peak_and_no_line_crosses_a_gap(fresh_seed: int) -> None:
    rng = np.random.default_rng(fresh_seed)
    rows = int(rng.integers(50, 3000))
    time, values = np.sort(rng.uniform(0, 100, rows)), rng.normal(size=rows)
    stretch = np.cumsum(rng.random(rows) < 0.01)
    x, y = envelope(time, values, stretch, 40)
    assert (np.nanmin(y), np.nanmax(y)) == (values.min(), values.max())
    assert np.isnan(y).sum() == stretch[-1] - stretch[0]
    assert (np.diff(x) >= 0).all()
    assert len(x) <= 2 * 40 + 4 * (stretch[-1] - stretch[0]) + 2
    # one by one each interval's peaks are there, within its stretch
    for number in np.unique(stretch):
        own = values[stretch == number]
        assert {own.min(), own.max()} <= set(y[~np.isnan(y)].tolist())


def test_logs_lie_one_behind_the_other_and_what_did_not_count_is_told() -> None:
    axis = drive_time(found(onset_from_start_s=5.0, onset_log=1))
    assert (np.diff(axis.along) > 0).all()
    assert len(axis.begins) == 2
    assert axis.begins[1] > 59.9
    spans = [(x.why, x.begin, x.end) for x in axis.uncounted]
    start = axis.begins[1]
    assert spans == [("driver", 20.0, 28.0), ("settling", 28.0, 30.0), ("standstill", start + 4.0, start + 6.0)]
    assert axis.onset == pytest.approx(axis.begins[1] + 5.0)
    warned = found(alarms=(Alarm(7.0, "change"), Alarm(3.0, "stability", 1)))
    assert [(x.detector, x.at) for x in drive_time(warned).alarms] == [("change", 7.0), ("stability", start + 3.0)]
    assert "alarm" in [text.get_text() for text in drive_figure(warned).legends[0].get_texts()]


@pytest.mark.parametrize(
    ("channels", "labels"),
    [
        (("accel", "speed"), ["acceleration [m/s²]", "speed [m/s]"]),
        (("speed",), ["command [m/s²]", "speed [m/s]"]),
        (("accel",), ["acceleration [m/s²]"]),
    ],
)
def test_a_panel_a_channel(channels: tuple[str, ...], labels: list[str]) -> None:
    figure = drive_figure(found(channels))
    assert [ax.get_ylabel() for ax in figure.axes] == labels
    names = [text.get_text() for text in figure.legends[0].get_texts()]
    grounds = {"driver", "settling", "standstill"}
    assert set(names) == grounds | {"next log", "command", "measured", "baseline simulator", "with what was named"}


def test_a_speed_that_drifts_does_not_squeeze_the_rest() -> None:
    log = found(("speed",))
    log.traces.before[0] += np.linspace(0, 1000, len(log.traces.time))
    low, high = drive_figure(log).axes[1].get_ylim()
    measured = log.traces.measured[0]
    # 0.3 of the measured range beyond either end
    assert high - low == pytest.approx(1.6 * np.ptp(measured))


def test_without_traces_there_is_nothing_to_draw() -> None:
    with pytest.raises(InputError, match="traces: the diagnosis has none to draw"):
        drive_time(found(traces=None))
