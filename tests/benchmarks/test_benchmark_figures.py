"""What a longer gap buys and costs, and operating curves, as drawn."""

from __future__ import annotations

import pytest
import torch
from matplotlib.figure import Figure

from avtorch.decision import Setting
from avtorch.errors import InputError
from benchmarks.detectors.operating_curves import operating_curve, operating_figure
from benchmarks.options.gap import gap_figure, gap_trade_off


def curve():
    z = torch.randn(2, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gaps = torch.tensor([1.0, 1.6, 2.0, 2.5], dtype=torch.float64)
    return gap_trade_off(1.5 * (0.05 * z[0]).exp(), 0.5 * (0.02 * z[1]).exp(), gaps, Setting())


def test_the_curves_are_the_figures() -> None:
    worn = curve()
    figure = gap_figure({"worn": worn}, marked=(1.6,))
    probability, peak, flow = figure.axes
    assert probability.lines[0].get_ydata().tolist() == worn.p_string_stable.tolist()
    assert peak.lines[0].get_ydata().tolist() == worn.peak_gain[1].tolist()
    assert flow.lines[0].get_ydata().tolist() == worn.throughput_vph.tolist()
    assert worn.least_gap() == 2.5
    assert "1.6 s: 1818" in [t.get_text() for t in flow.texts]


def test_operating_curves_leave_out_what_is_not_found() -> None:
    inf = float("inf")
    panels = {"drift": {"kl": [(0.1, 0.9, 2.0), (0.01, 0.1, 4.0)], "stability": [(0.9, 0.0, inf)]}}
    figure = operating_figure(panels)
    (line,) = figure.axes[0].lines
    assert list(line.get_xdata()) == [0.9, 0.1]
    assert list(line.get_ydata()) == [2.0, 4.0]
    with pytest.raises(InputError, match="curves"):
        operating_curve(Figure().subplots(), {})
