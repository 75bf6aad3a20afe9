"""Detectors compared: one pass serves every threshold; and curves as drawn."""

from __future__ import annotations

import math

import pytest
import torch
from matplotlib.figure import Figure

from avtorch.decision.divergence import Gaussian
from avtorch.decision.monitor import Monitor
from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from benchmarks.detectors.drives import Beliefs
from benchmarks.detectors.judge import DETECTORS, first_alarm, scores
from benchmarks.detectors.tables import Quiet, chosen, found, operating_curve, operating_figure, quiet

RUNS, WINDOWS = 80, 34


def clouds(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draws (window, run, draw) about a vehicle that changes after 25 windows in the first half of the runs."""
    g = torch.Generator().manual_seed(seed)
    centre = torch.tensor([math.log(0.3), 0.0], dtype=torch.float64).expand(WINDOWS, RUNS, 2).clone()
    centre[25:, : RUNS // 2] += torch.tensor([0.8, -0.25], dtype=torch.float64)
    centre = centre + torch.tensor([0.06, 0.03]) * torch.randn(WINDOWS, RUNS, 2, generator=g, dtype=torch.float64)
    z = torch.randn(WINDOWS, RUNS, 60, 2, generator=g, dtype=torch.float64)
    draws = (centre[:, :, None] + torch.tensor([0.06, 0.03]) * (z - z.mean(2, keepdim=True))).exp()
    used = torch.rand(WINDOWS, RUNS, generator=g) < 0.7
    return draws[..., 0], draws[..., 1], used


@pytest.mark.slow
@pytest.mark.parametrize("unevenness", [(0.0, 0.0), (0.1, 0.03)])
def test_first_alarms_are_the_monitors(fresh_seed: int, unevenness: tuple[float, float]) -> None:
    T, K, used = clouds(fresh_seed)
    end = 2.0 * torch.arange(1.0, WINDOWS + 1.0, dtype=torch.float64)
    alone = {n: Monitor(RUNS, detectors=[n], unevenness=unevenness) for n in DETECTORS}
    first = {n: torch.full((RUNS,), torch.inf, dtype=torch.float64) for n in DETECTORS}
    p, sure = [], []
    for i in range(WINDOWS):
        for name, monitor in alone.items():
            report = monitor.update(T[i], K[i], used[i], Setting(scenarios=RUNS))
            new = report.alerts[name] & torch.isinf(first[name])
            first[name] = torch.where(new, end[i], first[name])
            if name == "stability":
                p.append(report.statistics[name])
            elif name == "accepted_change":
                sure.append(report.statistics[name])
    belief = [Gaussian.of_draws(T[i], K[i]) for i in range(WINDOWS)]
    moments = Gaussian(torch.stack([b.mean for b in belief]), torch.stack([b.cov for b in belief]))
    none = torch.zeros(RUNS, dtype=torch.float64)
    beliefs = Beliefs(end, none, used, torch.stack(p), torch.stack(sure), moments, 0)
    seen = scores(beliefs, unevenness)
    for name, detector in DETECTORS.items():
        assert torch.equal(first_alarm(seen[name], end, detector.limit(detector.default)), first[name]), name
        assert bool(torch.isfinite(first[name][: RUNS // 2]).float().mean() > 0.5)


def test_intervals_and_delays_on_known_numbers() -> None:
    # Wilson (1927) by hand for none of 200: z² / (n + z²)
    assert Quiet(0, 200, 0.0).interval == pytest.approx((0.0, 1.959964**2 / (200 + 1.959964**2)))
    first = torch.tensor([5.0, 12.0, 14.0, 60.0, math.inf], dtype=torch.float64)
    f = found(first, torch.full((5,), 10.0, dtype=torch.float64))
    assert (f.early, f.soon, f.at_all) == (1, 2, 3)
    assert f.median_s == 4.0
    assert math.isinf(f.most_s)
    q = quiet(first, 100.0)
    assert (q.alarmed, q.runs) == (4, 5)
    assert q.per_hour == pytest.approx(4 / ((5 + 12 + 14 + 60 + 100) / 3600))


def test_the_readiest_quiet_value_is_chosen() -> None:
    end = torch.arange(1.0, 4.0, dtype=torch.float64)
    score = {n: torch.full((3, 10), -torch.inf, dtype=torch.float64) for n in DETECTORS}
    # one run in ten reaches a p-value of 10^-2.2
    score["kl"][1, 0] = 2.2
    beliefs = Beliefs(end, end[:1], score["kl"] > 0, score["kl"], score["kl"], Gaussian(end, end), 0)
    picked = chosen({"healthy": (beliefs, score)}, 0.05)
    assert picked["kl"] == pytest.approx(10**-2.5)
    assert picked["hellinger"] == 0.1
    assert chosen({"healthy": (beliefs, score)}, 0.1)["kl"] == 0.1


def test_operating_curves_leave_out_what_is_not_found() -> None:
    inf = float("inf")
    panels = {"drift": {"kl": [(0.1, 0.9, 2.0), (0.01, 0.1, 4.0)], "stability": [(0.9, 0.0, inf)]}}
    figure = operating_figure(panels)
    (line,) = figure.axes[0].lines
    assert list(line.get_xdata()) == [0.9, 0.1]
    assert list(line.get_ydata()) == [2.0, 4.0]
    with pytest.raises(InputError, match="curves"):
        operating_curve(Figure().subplots(), {})
